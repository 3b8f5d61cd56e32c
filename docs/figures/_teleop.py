"""TeleopContact behind a channel, with its scripted operator."""

from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from safe_wrappers.envs.teleop_contact import (
    CLAMP_Y,
    TELEOP_ACCELERATION,
    TELEOP_BRAKING,
    TELEOP_TOP_SPEED,
    TOOL_RADIUS,
)
from safe_wrappers.envs.teleop_operator import TeleopOperator

STEP_S = 0.001


def ceiling() -> sw.teleop.RoundTripCeiling:
    """Over the clearance to the clamp."""
    face = sw.constraints.Plane([0.0, CLAMP_Y], [0.0, -1.0])
    clamp = sw.constraints.Clearance(
        [face], TELEOP_BRAKING, bodies=["tool"], radius=TOOL_RADIUS, margin=0.001
    )
    return sw.teleop.RoundTripCeiling(
        sw.StoppingBudget(clamp, acceleration=TELEOP_ACCELERATION, top_speed=TELEOP_TOP_SPEED)
    )


def episode(
    delay_s: float, seconds: float, tool: tuple[float, float], stops: bool = True, **options: Any
) -> dict[str, np.ndarray]:
    """What happened in each step, by name: the tool's place, and the info's numbers."""
    env = sw.TeleopChannel(gym.make("TeleopContact-v0"), delay_s, delay_s, **options)
    layout = {"tool": list(tool), "wanted_force": 8.0}
    observation, _ = env.reset(seed=0, options={"layout": layout})
    operator = TeleopOperator(seed=0, stops=stops)
    rows: list[dict[str, Any]] = []
    raw: Any = env.unwrapped
    for _ in range(round(seconds / STEP_S)):
        observation, _, _, _, info = env.step(operator.act(observation))
        rows.append({**info, "x": raw.tool_position[0], "y": raw.tool_position[1]})
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}
