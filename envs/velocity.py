"""The velocity tasks: a standard Gymnasium robot that must not go faster than a published limit."""

import importlib
import itertools
import math
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from numpy.typing import NDArray

from safe_wrappers.errors import UnknownNameError
from safe_wrappers.info import COST, COST_SUBSTEP

from . import SPEED_LIMITS

VERSIONS: Final = ("v5", "v4")
"""Versions of Gymnasium's MuJoCo envs that a velocity task can be built on."""


class SafeVelocityEnv(MujocoEnv):
    """Adds the cost of speed to a standard env; its dynamics, observations and rewards stay bit for bit.

    **Speed**: displacement over the control step divided by the step's duration, exactly as the standard env
    reports it in ``info["x_velocity"]``. It is signed: running backwards costs nothing, however fast. Ant and
    Humanoid differ (`SafePlanarVelocityEnv`).

    **Info**, at every step and at reset, beside what the standard env reports: ``speed`` (float, m/s),
    ``cost`` (1.0 if the speed is above `speed_limit`, or is not a number, else 0.0; all 0 at reset) and
    ``cost_substep``, which equals ``cost``: the published limit is on the average over the whole control
    step, so there is no such thing as a violation at one physics substep, and ``qvel`` may well exceed the
    limit within a step that keeps it.

    A subclass has one robot's standard env as its second base, and sets `speed_limit`.
    """

    speed_limit: ClassVar[float]
    """The highest speed that costs nothing, m/s."""

    # MujocoEnv's signature promises NumPy scalars where Env's promises Python's.
    def step(  # type: ignore[override]
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Step the standard env and judge the speed of the step."""
        observation, reward, terminated, truncated, info = super().step(action)
        speed = self._judged_speed(info)
        cost = float(not speed <= self.speed_limit)  # so that a speed that is not a number costs
        judged = {"speed": speed, COST: cost, COST_SUBSTEP: cost}
        return observation, reward, terminated, truncated, {**info, **judged}

    def _get_reset_info(self) -> dict[str, Any]:
        return {**super()._get_reset_info(), "speed": 0.0, COST: 0.0, COST_SUBSTEP: 0.0}

    def _judged_speed(self, info: dict[str, Any]) -> float:
        return float(info["x_velocity"])


class SafePlanarVelocityEnv(SafeVelocityEnv):
    """The same for a robot that can go anywhere in the plane: the speed is the norm over x and y.

    The point judged is the one whose velocity Gymnasium reports: Ant's torso (v5's ``main_body``), Humanoid's
    centre of mass. Gymnasium reads its position from ``data.xpos`` and ``data.xipos`` after `mj_step`, which
    hold the last trial state of MuJoCo's Runge-Kutta step, not the state reached. Against the displacement
    of ``qpos`` that moved the speed by 0.002 m/s in the median and 0.11 at most for Ant, by 0.0001 and 0.003
    for Humanoid (random actions, 2,000 steps). It is what is published, so it is what is judged.
    """

    def _judged_speed(self, info: dict[str, Any]) -> float:
        x, y = float(info["x_velocity"]), float(info["y_velocity"])
        return math.sqrt(x * x + y * y)


def make_velocity_env(robot: str, version: str = "v5", **kwargs: Any) -> SafeVelocityEnv:
    """Make the velocity task of a robot; what `gymnasium.make("Safe<robot>Velocity-v0", ...)` calls.

    Args:
        robot: A key of `SPEED_LIMITS`.
        version: Whose physics, observations and rewards: "v5", or "v4" to stand beside published numbers,
            which were measured on v4 (with an older MuJoCo).
        kwargs: Passed to Gymnasium's env of that version: `render_mode`, `forward_reward_weight`, ...

    Raises:
        UnknownNameError: No such robot or version.

    Example:
        >>> import gymnasium as gym, safe_wrappers
        >>> env = gym.make("SafeSwimmerVelocity-v0", version="v4")
        >>> env.unwrapped.speed_limit
        0.2282
        >>> _ = env.reset(seed=0)
        >>> env.step(env.action_space.low)[4]["cost"]
        0.0
    """
    for name, value, known in (("robot", robot, tuple(SPEED_LIMITS)), ("version", version, VERSIONS)):
        if value not in known:
            raise UnknownNameError(f"{name} must be one of {', '.join(map(repr, known))}; got {value!r}")
    env: SafeVelocityEnv = __getattr__(f"Safe{robot}Velocity{version}Env")(**kwargs)
    return env


def __getattr__(name: str) -> Any:
    """The class of a robot and a version, as in `SafeAntVelocityv5Env`: made when it is asked for, also by pickle."""
    for robot, version in itertools.product(SPEED_LIMITS, VERSIONS):
        if name == f"Safe{robot}Velocity{version}Env":
            break
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name not in globals():
        file = "half_cheetah" if robot == "HalfCheetah" else robot.lower()
        standard = getattr(importlib.import_module(f"gymnasium.envs.mujoco.{file}_{version}"), f"{robot}Env")
        base = SafePlanarVelocityEnv if robot in ("Ant", "Humanoid") else SafeVelocityEnv
        about = {"__module__": __name__, "__doc__": f"{robot}-{version} with the cost of speed."}
        globals()[name] = type(name, (base, standard), {**about, "speed_limit": SPEED_LIMITS[robot]})
    return globals()[name]


# Without it `gymnasium.make` does not know "rgb_array_list"; every robot and version has the same render modes.
make_velocity_env.metadata = {  # type: ignore[attr-defined]
    "render_modes": HalfCheetahEnv.metadata["render_modes"]
}
