"""Registered tasks, imported as ``safe_wrappers.envs``: the package that knows MJCF and rewards.

Importing this module imports neither MuJoCo nor any environment: the ids point to their classes by name, and
`gymnasium.make` imports a class when it is asked for.
"""

from typing import Final

import gymnasium as gym

EPISODE_STEPS: Final = 1000
"""Control steps per episode, after which `TimeLimit` truncates (20 s with the point, 40 s with the car)."""

POINT_GOAL_IDS: Final = tuple(f"SafePointGoal{level}-v0" for level in range(3))
"""Ids of the goal task with the point robot, by level."""

CAR_GOAL_IDS: Final = tuple(f"SafeCarGoal{level}-v0" for level in range(3))
"""Ids of the goal task with the car, by level."""

SPEED_LIMITS: Final = {
    "HalfCheetah": 3.2096,
    "Hopper": 0.7402,
    "Walker2d": 2.3415,
    "Swimmer": 0.2282,
    "Ant": 2.6222,
    "Humanoid": 1.4149,
}
"""By robot, m/s (Safety-Gymnasium, its velocity tasks v1): along x, for Ant and Humanoid in the plane."""

VELOCITY_IDS: Final = tuple(f"Safe{robot}Velocity-v0" for robot in SPEED_LIMITS)
"""Ids of the velocity tasks: Gymnasium's robots with a published speed limit."""

FLEX_JOINT_REACH_ID: Final = "FlexJointReach-v0"
"""Id of the reaching task with elastic joints."""

SAFE_ROVER_ID: Final = "SafeRover-v0"
"""Id of the rover on dry, wet and icy ground."""

OCCLUDED_CROSSING_ID: Final = "OccludedCrossing-v0"
"""Id of the road to cross between cars that hide behind pillars."""

PATROLLED_MAZE_ID: Final = "PatrolledPointMaze-v0"
"""Id of gymnasium-robotics' PointMaze with patrols that its walls hide."""

TELEOP_CONTACT_ID: Final = "TeleopContact-v0"
"""Id of the remote end of a teleoperation: a tool before a stiff wall."""


_CLASSES: Final = {
    FLEX_JOINT_REACH_ID: ("flex_joint_reach:FlexJointReachEnv", 200),  # 2 s
    SAFE_ROVER_ID: ("safe_rover:SafeRoverEnv", EPISODE_STEPS),
    OCCLUDED_CROSSING_ID: ("occluded_crossing:OccludedCrossingEnv", 500),  # 20 s
    PATROLLED_MAZE_ID: ("patrolled_maze:PatrolledPointMazeEnv", EPISODE_STEPS),
    TELEOP_CONTACT_ID: ("teleop_contact:TeleopContactEnv", 6000),  # 6 s
}


def register_envs() -> None:
    """Register every task of this package with Gymnasium; ids already there are left alone."""
    for robot, ids in (("Point", POINT_GOAL_IDS), ("Car", CAR_GOAL_IDS)):
        for level, env_id in enumerate(ids):
            _register(env_id, f"goal_env:Safe{robot}GoalEnv", EPISODE_STEPS, {"level": level})
    for robot, env_id in zip(SPEED_LIMITS, VELOCITY_IDS, strict=True):
        _register(env_id, "velocity:make_velocity_env", EPISODE_STEPS, {"robot": robot})
    for env_id, (where, steps) in _CLASSES.items():
        _register(env_id, where, steps, {})


def _register(env_id: str, where: str, steps: int, kwargs: dict[str, object]) -> None:
    if env_id not in gym.registry:
        entry_point = f"safe_wrappers.envs.{where}"
        gym.register(env_id, entry_point=entry_point, kwargs=kwargs, max_episode_steps=steps)


__all__ = [
    "CAR_GOAL_IDS",
    "EPISODE_STEPS",
    "FLEX_JOINT_REACH_ID",
    "OCCLUDED_CROSSING_ID",
    "PATROLLED_MAZE_ID",
    "POINT_GOAL_IDS",
    "SAFE_ROVER_ID",
    "SPEED_LIMITS",
    "TELEOP_CONTACT_ID",
    "VELOCITY_IDS",
    "register_envs",
]
