"""Who acts at every control step: the whole stack, on a cart that drives at a wall while its policy falls silent."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import safe_wrappers as sw
from _cart import Cart, plant, wall
from _style import FORBIDDEN, GRID, INK, ON, SAFE
from lease_expiry import stop

STEP_S, WALL = 0.05, 3.0
CHUNK, HORIZON, DELAY = 16, 4, 2
SILENT = range(8, 18)
"""Chunks that never arrive."""
CHUNKS = 40


class Log(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps the info of every control step: outside, a step is a chunk."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.infos: list[dict[str, Any]] = []

    def step(self, action: Any) -> Any:
        """One control step."""
        stepped = self.env.step(action)
        self.infos.append(dict(stepped[4]))
        return stepped


def planned(state: NDArray[np.float64]) -> NDArray[np.float64]:
    """A chunk that keeps 0.9 m/s and knows nothing of the wall."""
    v, chunk = state[1], []
    for _ in range(CHUNK):
        chunk.append(float(np.clip(2.0 * (0.9 - v), -1.0, 1.0)))
        v += STEP_S * chunk[-1]
    return np.array(chunk)[:, None]


def run() -> tuple[Cart, Log, list[dict[str, Any]]]:
    """Handover over lease over filter."""
    cart = Cart((0.0, 0.0), dt=STEP_S)
    filtered = sw.CBFActionFilter(cart, [wall(WALL)], plant=plant(cart))
    lease = sw.LeaseExpiry(
        filtered,
        sw.StoppingBudget(wall(WALL), acceleration=1.0),
        min_lease_s=HORIZON * STEP_S,
        blend_time=0.2,
        fallback=stop,
        plant=plant(cart),
    )
    log = Log(lease)
    env = sw.ChunkHandover(log, CHUNK, HORIZON, DELAY, rate_limit=4.0, fallback="zero")
    env.reset(seed=0)
    infos = []
    for number in range(CHUNKS):
        if number in SILENT:
            env.set_observation_time(None)
        infos.append(env.step(planned(cart.state))[4])
    return cart, log, infos


def draw() -> Figure:
    """Above: the distance to the wall. Below: who acts."""
    cart, log, chunks = run()
    time = STEP_S * np.arange(len(log.infos))
    figure = Figure(figsize=(7.2, 3.9))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    fine = np.array(cart.fine)
    above.plot(np.arange(len(fine)) * STEP_S / 20, WALL - fine[:, 0], color=ON)
    above.axhline(0.0, color=FORBIDDEN, lw=1.2)
    above.set_ylabel("distance to\nthe wall (m)")
    braking = np.array([i["lease/braking"] for i in log.infos])
    changed = np.array([i["cbf/intervened"] for i in log.infos])
    starved = np.repeat([i["handover/starved"] == HORIZON for i in chunks], HORIZON)
    rows = (
        ("a chunk", ~braking & ~starved, ON),
        ("the lease's brake", braking, FORBIDDEN),
        ("changed by the filter", changed, SAFE),
    )
    for row, (_, acts, color) in enumerate(reversed(rows)):
        below.broken_barh(
            [(t, STEP_S) for t in time[acts]], (row - 0.3, 0.6), facecolors=color, edgecolors="none"
        )
    below.set_yticks(range(len(rows)), [name for name, _, _ in reversed(rows)])
    below.tick_params(left=False)
    below.set_xlabel("time (s)")
    silence = STEP_S * HORIZON * SILENT.start, STEP_S * HORIZON * SILENT.stop
    for ax in (above, below):
        ax.axvspan(*silence, color=GRID, alpha=0.25, lw=0, zorder=0)
    above.text(sum(silence) / 2, 2.6, "no chunk arrives", ha="center", color=INK)
    return figure
