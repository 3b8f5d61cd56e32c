"""Registered tasks, imported as ``safe_wrappers.envs``: the package that knows MJCF and rewards.

The ids point to their classes by name, and `gymnasium.make` imports a class when it is asked for.
"""

from typing import Final

import gymnasium as gym

EPISODE_STEPS: Final = 1000
"""Control steps per episode, after which `TimeLimit` truncates (20 s with the point, 40 s with the car)."""

SPEED_LIMITS: Final = {
    "HalfCheetah": 3.2096,
    "Hopper": 0.7402,
    "Walker2d": 2.3415,
    "Swimmer": 0.2282,
    "Ant": 2.6222,
    "Humanoid": 1.4149,
}
"""By robot, m/s (Safety-Gymnasium, its velocity tasks v1): along x, for Ant and Humanoid in the plane."""

_CLASSES: Final = {
    "FlexJointReach-v0": ("flex_joint_reach:FlexJointReachEnv", 200),  # 2 s
    "SafeRover-v0": ("safe_rover:SafeRoverEnv", EPISODE_STEPS),
    "OccludedCrossing-v0": ("occluded_crossing:OccludedCrossingEnv", 500),  # 20 s
    "PatrolledPointMaze-v0": ("patrolled_maze:PatrolledPointMazeEnv", EPISODE_STEPS),
    "TeleopContact-v0": ("teleop_contact:TeleopContactEnv", 6000),  # 6 s
}


def register_envs() -> None:
    """Register every task of this package with Gymnasium; ids already there are left alone."""
    for robot in ("Point", "Car"):
        for level in range(3):
            where = f"goal_env:Safe{robot}GoalEnv"
            _register(f"Safe{robot}Goal{level}-v0", where, EPISODE_STEPS, {"level": level})
    for robot in SPEED_LIMITS:
        _register(f"Safe{robot}Velocity-v0", "velocity:make_velocity_env", EPISODE_STEPS, {"robot": robot})
    for env_id, (where, steps) in _CLASSES.items():
        _register(env_id, where, steps, {})


def _register(env_id: str, where: str, steps: int, kwargs: dict[str, object]) -> None:
    if env_id not in gym.registry:
        entry_point = f"safe_wrappers.envs.{where}"
        gym.register(env_id, entry_point=entry_point, kwargs=kwargs, max_episode_steps=steps)


__all__ = ["EPISODE_STEPS", "SPEED_LIMITS", "register_envs"]
