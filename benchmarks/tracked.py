"""The sensors and tracks of the tasks in which something moves unseen, as they are trained with."""

from typing import Any

import gymnasium as gym

import safe_wrappers as sw

CROSSING: dict[str, Any] = {
    # 2 * 0.15^2 / 2 = 0.0225 m^2/s^3 along their lanes, and nothing across: safe_wrappers.envs.traffic.
    "tracks": [
        {
            "bodies": bodies,
            "mean_velocity": [mean, 0],
            "acceleration_noise": [0.0225, 0],
            "reversion_s": 2.0,
            "start_position_std": [0.3, 0],
            "start_velocity_std": [0.15, 0],
        }
        for bodies, mean in (("car[012]", 1), ("car[345]", -1))
    ],
    "sensor": {"camera": "eye", "view_deg": 120, "range_m": 6, "position_std": 0.05},
    "tolerance": 0.5,
}
"""Of OccludedCrossing: as configs/occluded_crossing_ppo.yaml has it."""

PATROLLED: dict[str, Any] = {
    # 2 * (0.5^2 + 0.15^2) / 2 = 0.2725 m^2/s^3 along the corridor: safe_wrappers.envs.patrolled_maze.
    "tracks": [
        {
            "published": "patrol_positions",
            "acceleration_noise": [0.2725, 0],
            "reversion_s": 2.0,
            "start_position_std": [0.1, 0],
            "start_velocity_std": [0.55, 0],
        }
    ],
    "sensor": {"site": "particle_site", "position_std": 0.02},
    "tolerance": 0.5,
}
"""Of PatrolledPointMaze on the U maze."""


PATROLS_AT_ONCE: dict[str, Any] = PATROLLED | {
    # The same spread of speeds in the long run, 2 * 0.2725 / 2 = q * 0.25 / 2 m^2/s^2; it may turn about at any time.
    "tracks": [PATROLLED["tracks"][0] | {"acceleration_noise": [2.18, 0], "reversion_s": 0.25}]
}
"""Of PatrolledPointMaze, told that a patrol turns about within a quarter of a second."""


def crossing(env: gym.Env[Any, Any], **changes: Any) -> sw.OcclusionPenalty:
    """OccludedCrossing with its cars tracked."""
    return sw.OcclusionPenalty(env, **(CROSSING | changes))


def patrolled(env: gym.Env[Any, Any], **changes: Any) -> sw.OcclusionPenalty:
    """PatrolledPointMaze with its patrols tracked."""
    return sw.OcclusionPenalty(env, **(PATROLLED | changes))
