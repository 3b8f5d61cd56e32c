"""Registered tasks, imported as ``safe_wrappers.envs``: the package that knows MJCF and rewards.

Importing this module imports neither MuJoCo nor any environment: the ids point to their classes by name, and
`gymnasium.make` imports a class when it is asked for.
"""

from typing import Final

import gymnasium as gym

EPISODE_STEPS: Final = 1000
"""Control steps per episode, after which `TimeLimit` truncates (20 s with the point, 40 s with the car)."""

REACH_EPISODE_STEPS: Final = 200
"""The same for the arm with elastic joints: 2 s at 100 Hz."""

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

CROSSING_EPISODE_STEPS: Final = 500
"""`EPISODE_STEPS` of the crossing: 20 s at 25 Hz."""

OCCLUDED_CROSSING_ID: Final = "OccludedCrossing-v0"
"""Id of the road to cross between cars that hide behind pillars."""

PATROLLED_MAZE_ID: Final = "PatrolledPointMaze-v0"
"""Id of gymnasium-robotics' PointMaze with patrols that its walls hide."""


TELEOP_EPISODE_STEPS: Final = 6000
"""`EPISODE_STEPS` of the teleoperation: 6 s at 1 kHz."""

TELEOP_CONTACT_ID: Final = "TeleopContact-v0"
"""Id of the remote end of a teleoperation: a tool before a stiff wall."""


def register_envs() -> None:
    """Register every task of this package with Gymnasium; ids already there are left alone."""
    for level, env_id in enumerate(POINT_GOAL_IDS):
        _register(env_id, "safe_wrappers.envs.goal_env:SafePointGoalEnv", {"level": level})
    for level, env_id in enumerate(CAR_GOAL_IDS):
        _register(env_id, "safe_wrappers.envs.goal_env:SafeCarGoalEnv", {"level": level})
    for env_id in VELOCITY_IDS:
        robot = env_id.removeprefix("Safe").removesuffix("Velocity-v0")
        _register(env_id, "safe_wrappers.envs.velocity:make_velocity_env", {"robot": robot})
    reach = "safe_wrappers.envs.flex_joint_reach:FlexJointReachEnv"
    _register(FLEX_JOINT_REACH_ID, reach, {}, steps=REACH_EPISODE_STEPS)
    _register(SAFE_ROVER_ID, "safe_wrappers.envs.safe_rover:SafeRoverEnv", {})
    crossing = "safe_wrappers.envs.occluded_crossing:OccludedCrossingEnv"
    _register(OCCLUDED_CROSSING_ID, crossing, {}, steps=CROSSING_EPISODE_STEPS)
    _register(PATROLLED_MAZE_ID, "safe_wrappers.envs.patrolled_maze:PatrolledPointMazeEnv", {})
    teleop = "safe_wrappers.envs.teleop_contact:TeleopContactEnv"
    _register(TELEOP_CONTACT_ID, teleop, {}, steps=TELEOP_EPISODE_STEPS)


def _register(env_id: str, entry_point: str, kwargs: dict[str, object], steps: int = EPISODE_STEPS) -> None:
    if env_id not in gym.registry:
        gym.register(env_id, entry_point=entry_point, kwargs=kwargs, max_episode_steps=steps)


__all__ = [
    "CAR_GOAL_IDS",
    "CROSSING_EPISODE_STEPS",
    "EPISODE_STEPS",
    "FLEX_JOINT_REACH_ID",
    "OCCLUDED_CROSSING_ID",
    "PATROLLED_MAZE_ID",
    "POINT_GOAL_IDS",
    "REACH_EPISODE_STEPS",
    "SAFE_ROVER_ID",
    "SPEED_LIMITS",
    "TELEOP_CONTACT_ID",
    "TELEOP_EPISODE_STEPS",
    "VELOCITY_IDS",
    "register_envs",
]
