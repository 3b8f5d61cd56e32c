"""A policy falls silent on the way to a wall: with a lease, and without one."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _cart import Cart, plant
from _style import FORBIDDEN, GRID, OFF, ON, SAFE, panels

STEP_S, WALL, TOP_SPEED = 0.05, 3.0, 1.0
SILENT = (1.0, 3.5)
"""s, when no command arrives."""
STEPS = 140


def read(env: Any) -> tuple[float, float]:
    """Clearance (m) and approach speed (m/s)."""
    x, v = env.unwrapped.state
    return WALL - x, v


def stop(known: Any) -> list[float]:
    """The brake: against the motion, and nothing at rest."""
    return [float(np.clip(-known.state[1] / STEP_S, -1.0, 1.0))]


def policy(state: Any) -> float:
    """Drives on as fast as it can, and halts 30 cm before the wall: while it lives."""
    x, v = state
    wanted = min(TOP_SPEED, np.sqrt(max(WALL - 0.3 - x, 0.0)))
    return float(np.clip(5.0 * (wanted - v), -1.0, 1.0))


def run(leased: bool) -> tuple[Any, list[dict[str, Any]]]:
    """Clearance at every step, and what the lease said."""
    cart = Cart((0.0, 0.0), dt=STEP_S)
    lease = sw.LeaseExpiry(
        cart,
        sw.StoppingBudget(read, braking=1.0, acceleration=1.0),
        blend_time=0.3,
        fallback=stop,
        plant=plant(cart),
    )
    env: Any = lease if leased else cart
    env.reset(seed=0)
    clearance, infos, action = [WALL], [], np.zeros(1)
    for step in range(STEPS):
        silent = SILENT[0] <= step * STEP_S < SILENT[1]
        if not silent:
            action = np.array([policy(cart.state)])
        elif leased:
            lease.set_observation_time(None)
        infos.append(env.step(action)[4])
        clearance.append(WALL - cart.state[0])
    return np.array(clearance), infos


def draw() -> Figure:
    """Left: the clearance. Right: the lease, renewed and counted down."""
    figure, (left, right) = panels(2, height=2.9)
    time = STEP_S * np.arange(STEPS + 1)
    alone, _ = run(leased=False)
    kept, infos = run(leased=True)
    left.plot(time, alone, color=OFF, label="no lease")
    left.plot(time, kept, color=ON, label="lease")
    left.axhline(0.0, color=FORBIDDEN, lw=1.2)
    left.text(0.05, -0.05, "wall", color=FORBIDDEN, va="top")
    left.set(ylim=(-0.5, 3.1), ylabel="clearance (m)")
    left.legend(loc="upper right")
    right.plot(time[1:], [i["lease/remaining_s"] for i in infos], color=SAFE)
    braking = np.array([i["lease/braking"] for i in infos])
    right.plot(time[1:][braking], np.zeros(braking.sum()), ".", color=FORBIDDEN, ms=5, label="lease/braking")
    right.set_ylabel("lease/remaining_s")
    right.legend(loc="upper right")
    for ax in (left, right):
        ax.axvspan(*SILENT, color=GRID, alpha=0.25, lw=0, zorder=0)
        ax.set_xlabel("time (s)")
    left.text(sum(SILENT) / 2, 2.75, "silence", ha="center")
    return figure
