"""Registered tasks, imported as ``safe_wrappers.envs``: the package that knows MJCF and rewards.

Importing this module imports neither MuJoCo nor any environment: the ids point to their classes by name, and
`gymnasium.make` imports a class when it is asked for.
"""

from typing import Final

import gymnasium as gym

EPISODE_STEPS: Final = 1000
"""Control steps per episode, after which `TimeLimit` truncates (20 s at 50 Hz)."""

POINT_GOAL_IDS: Final = tuple(f"SafePointGoal{level}-v0" for level in range(3))
"""Ids of the goal task with the point robot, by level."""


def register_envs() -> None:
    """Register every task of this package with Gymnasium; ids already there are left alone."""
    for level, env_id in enumerate(POINT_GOAL_IDS):
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point="safe_wrappers.envs.point_goal:SafePointGoalEnv",
                kwargs={"level": level},
                max_episode_steps=EPISODE_STEPS,
            )


__all__ = ["EPISODE_STEPS", "POINT_GOAL_IDS", "register_envs"]
