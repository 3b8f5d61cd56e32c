"""The same operator through the same delay: the wall's force and the energy, plain and with waves; and the clamp."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, OFF, ON, OTHER
from safe_wrappers.envs.teleop_contact import (
    CLAMP_Y,
    TELEOP_ACCELERATION,
    TELEOP_BRAKING,
    TELEOP_TOP_SPEED,
    TOOL_RADIUS,
)
from safe_wrappers.envs.teleop_operator import TeleopOperator

STEP_S = 0.001
DELAY_S = 0.1
SECONDS = 4.0


def budget() -> sw.StoppingBudget:
    """Over the clearance to the clamp."""
    face = sw.constraints.Plane([0.0, CLAMP_Y], [0.0, -1.0])
    clamp = sw.constraints.Clearance(
        [face], TELEOP_BRAKING, bodies=["tool"], radius=TOOL_RADIUS, margin=0.001
    )
    return sw.StoppingBudget(clamp, acceleration=TELEOP_ACCELERATION, top_speed=TELEOP_TOP_SPEED)


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


def draw() -> Figure:
    """Above force and energy over time; below the clearance, authority revoked and not."""
    figure = Figure(figsize=(7.2, 5.2))
    force, energy, clearance = figure.subplot_mosaic("FE;CC").values()
    time = STEP_S * np.arange(round(SECONDS / STEP_S))
    for coding, impedance, color in (("plain", None, OFF), ("wave", 40.0, ON)):
        seen = episode(DELAY_S, SECONDS, (0.17, 0.0), impedance=impedance)
        force.plot(time, seen["contact_force"], color=color, lw=1.2, label=coding)
        energy.plot(time, seen["teleop/created_j"], color=color, label=coding)
    force.axhline(8.0, color=GRID, lw=1.0)
    force.text(0.05, 9.0, "wanted", color=GRID)
    force.set_ylabel("force of the wall (N)")
    energy.set_ylabel("energy created (J)")
    for ax in (force, energy):
        ax.set_xlabel("time (s)")
        ax.legend(loc="upper left" if ax is energy else "upper right")
    for watched, color, label in (
        (False, OFF, "without a ceiling"),
        (True, ON, "with a ceiling"),
    ):
        watch = budget() if watched else None
        seen = episode(DELAY_S, SECONDS, (0.18, 0.1), False, impedance=40.0, budget=watch)
        time = STEP_S * np.arange(len(seen["clearance"]))
        clearance.plot(time, 1000.0 * seen["clearance"], color=color, label=label)
        if watched:
            low, high = -8.0, 150.0
            clearance.fill_between(
                time, low, high, where=seen["teleop/revoked"], color=OTHER, alpha=0.2, lw=0, label="revoked"
            )
            clearance.set_ylim(low, high)
    clearance.axhline(0.0, color=FORBIDDEN, lw=1.0)
    clearance.text(0.02, 3.0, "clamp", color=FORBIDDEN)
    clearance.set(ylabel="clearance (mm)", xlabel="time (s)")
    clearance.legend(loc="upper right")
    return figure
