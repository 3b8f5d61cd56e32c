"""What the package's own tasks have in common: how a step goes, layouts, goals that move on."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from safe_wrappers.errors import Array, SafeWrappersError, finite_action
from safe_wrappers.info import GOALS_REACHED

from .layout import Given

ASSETS: Final = Path(__file__).parent / "assets"
"""Where the models are."""
PARKED: Final = 1000.0
"""m: where objects outside the scenario are, farther than a robot gets in an episode."""
METADATA: Final[dict[str, Any]] = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}


class TaskEnv(MujocoEnv, EzPickle):
    """Base of the tasks: an action is held for a control step, which is judged and observed at its end.

    Args:
        asset: File of the model.
        frame_skip: Physics substeps per control step.
        space: Of the observations, float64; or how many numbers they have, without bounds.
        camera: Where a free camera stands, if the user does not say.
        kwargs: Passed to `gymnasium.envs.mujoco.MujocoEnv`.
    """

    _given: Given = {}  # noqa: RUF012 (never changed)

    def __init__(
        self, asset: str, frame_skip: int, space: Box | int, camera: dict[str, Any], **kwargs: Any
    ) -> None:
        if isinstance(space, int):
            space = Box(-np.inf, np.inf, (space,), dtype=np.float64)
        kwargs.setdefault("default_camera_config", camera)
        super().__init__(str(ASSETS / asset), frame_skip, space, **kwargs)

    def _parse(self, options: Mapping[str, Any] | None) -> Given:
        """The layout among `reset`'s options."""
        return {}

    @abstractmethod
    def _reward(self) -> float:
        """Of the control step that was just made."""

    @abstractmethod
    def observe(self) -> Array:
        """Observation of the state as it is now: also right after `set_state`."""

    def _is_finite(self, observation: Array) -> bool:
        """Whether the physics has left numbers."""
        return True

    def _is_over(self) -> bool:
        """Whether the episode terminates."""
        return False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; ``options["layout"]`` fixes parts of the scenario.

        Raises:
            UnknownNameError: An unknown layout key.
            ConfigurationError: A layout that cannot be used.
        """
        self._given = self._parse(options)
        observation, info = super().reset(seed=seed, options=options)
        return observation, info

    # MujocoEnv's signature promises NumPy scalars where Env's promises Python's: ours are Python's.
    def step(  # type: ignore[override]
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action for one control step.

        Raises:
            ActionError: Wrong shape, or a number that is not finite; the env was not stepped.
            SafeWrappersError: The physics left finite numbers.
        """
        self._step_mujoco_simulation(finite_action(action, self.model.nu), self.frame_skip)  # type: ignore[no-untyped-call]
        reward = self._reward()
        observation = self.observe()
        if not self._is_finite(observation):
            raise SafeWrappersError("the state is not finite: one that was set, or a changed model, broke it")
        if self.render_mode == "human":
            self.render()  # type: ignore[no-untyped-call]
        return observation, reward, self._is_over(), False, self._get_reset_info()


class FieldEnv(TaskEnv):
    """Base of tasks in which a robot, whose first two coordinates are its x and y in m, drives to goals.

    **Reward**: distance to the goal gained in a control step (m), plus 1 on coming within `goal_radius` of it; then a
    new goal is sampled and the episode goes on; ``info["goal_met"]`` says that this step reached one.
    """

    metadata: dict[str, Any] = {**METADATA, "render_fps": 50}  # noqa: RUF012 (Gymnasium's)

    goal_radius: ClassVar[float]
    """Distance from the goal's centre at which it counts as reached, m."""
    _targets: Array
    """Centres in the plane, the goal's first, shape (n, 2), m."""
    _goal_met = False
    _goals_reached = 0

    @abstractmethod
    def _next_goal(self) -> Array:
        """A new goal's centre, shape (2,), m."""

    @property
    def agent_position(self) -> Array:
        """The robot's centre, shape (2,), m; from qpos, never a substep behind as xpos is after mj_step."""
        return np.array(self.data.qpos[:2])

    @property
    def goal_position(self) -> Array:
        """Goal's centre, shape (2,), m."""
        return np.array(self._targets[0])

    def step(  # type: ignore[override]
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        self._before = self._goal_distance()
        return super().step(action)

    def _reward(self) -> float:
        distance = self._goal_distance()
        reward = self._before - distance
        self._goal_met = distance <= self.goal_radius
        if self._goal_met:
            reward += 1.0
            self._goals_reached += 1
            self.place_goal(self._next_goal())
        return reward

    def _get_reset_info(self) -> dict[str, Any]:
        return {"goal_met": self._goal_met, GOALS_REACHED: self._goals_reached}

    def _begin(self, goal: Array, fixed: Array, *others: Array) -> None:
        """A new episode: no goal reached, and what the lidars see stands at these centres, shapes (n, 2), m.

        What is `fixed` are the mocap bodies behind the goal; those that are more are parked.
        """
        self._goals_reached, self._goal_met = 0, False
        self._targets = np.concatenate([goal[None], fixed, *others])
        self.data.mocap_pos[1:, :2] = PARKED
        self.data.mocap_pos[1 : 1 + len(fixed), :2] = fixed
        self.place_goal(goal)

    def place_goal(self, goal: Array) -> None:
        """Move the goal to a centre, shape (2,), m; the next step's reward counts from there."""
        self._targets[0] = goal
        self.data.mocap_pos[0, :2] = goal

    def _goal_distance(self) -> float:
        goal, qpos = self._targets[0], self.data.qpos
        return math.hypot(goal[0] - qpos[0], goal[1] - qpos[1])
