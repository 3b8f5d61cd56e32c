"""What the tasks with goals on a field have in common: layouts, what a step earns, and goals that move on."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from safe_wrappers.checks import Array, finite_action
from safe_wrappers.errors import SafeWrappersError
from safe_wrappers.info import GOALS_REACHED

from .goal_layout import Given

GOAL_MET: Final = "goal_met"
"""bool: this step reached the goal (a new one stands already)."""


class FieldEnv(MujocoEnv, EzPickle):
    """Base of tasks in which a robot, whose first two coordinates are its x and y in m, drives to goals.

    **Reward**: distance to the goal gained in a control step (m), plus 1 on coming within `goal_radius` of it; then a
    new goal is sampled and the episode goes on.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it on the instance)
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
        "render_fps": 50,
    }

    goal_radius: ClassVar[float]
    """Distance from the goal's centre at which it counts as reached, m."""
    _given: Given = {}  # noqa: RUF012 (never changed)
    _targets: Array
    """Centres in the plane, the goal's first, shape (n, 2), m."""
    _goal_met = False
    _goals_reached = 0

    @abstractmethod
    def _parse(self, options: Mapping[str, Any] | None) -> Given:
        """The layout among `reset`'s options."""

    @abstractmethod
    def _next_goal(self) -> Array:
        """A new goal's centre, shape (2,), m."""

    @abstractmethod
    def observe(self) -> Array:
        """Observation of the state as it is now: also right after `set_state`."""

    def _is_finite(self, observation: Array) -> bool:
        """Whether the physics has left numbers."""
        return True

    def _is_over(self) -> bool:
        """Whether the episode terminates."""
        return False

    @property
    def agent_position(self) -> Array:
        """The robot's centre, shape (2,), m; from qpos, never a substep behind as xpos is after mj_step."""
        return np.array(self.data.qpos[:2])

    @property
    def goal_position(self) -> Array:
        """Goal's centre, shape (2,), m."""
        return np.array(self._targets[0])

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
        control = finite_action(action, self.model.nu)
        before = self._goal_distance()
        self._step_mujoco_simulation(control, self.frame_skip)  # type: ignore[no-untyped-call]
        distance = self._goal_distance()
        reward = before - distance
        self._goal_met = distance <= self.goal_radius
        if self._goal_met:
            reward += 1.0
            self._goals_reached += 1
            self.place_goal(self._next_goal())
        observation = self.observe()
        if not self._is_finite(observation):
            raise SafeWrappersError("the state is not finite: one that was set, or a changed model, broke it")
        if self.render_mode == "human":
            self.render()  # type: ignore[no-untyped-call]
        return observation, reward, self._is_over(), False, self._get_reset_info()

    def _get_reset_info(self) -> dict[str, Any]:
        return {GOAL_MET: self._goal_met, GOALS_REACHED: self._goals_reached}

    def place_goal(self, goal: Array) -> None:
        """Move the goal to a centre, shape (2,), m; the next step's reward counts from there."""
        self._targets[0] = goal
        self.data.mocap_pos[0, :2] = goal

    def _goal_distance(self) -> float:
        goal, qpos = self._targets[0], self.data.qpos
        return math.hypot(goal[0] - qpos[0], goal[1] - qpos[1])
