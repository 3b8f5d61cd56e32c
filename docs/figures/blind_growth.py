"""How the standard deviation of a position grows while nothing is seen, and when that is more than can be borne."""

import numpy as np
from matplotlib.figure import Figure

from _style import FORBIDDEN, GRID, INK, OFF, ON, OTHER, panels
from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.covariance import discretise

P0 = np.diag([0.05**2, 0.15**2])
INTENSITY = 0.0225
TOLERANCE = 1.0
LONGEST_S = 3.0
A = np.array([[0.0, 1.0], [0.0, 0.0]])
REVERTING = np.array([[0.0, 1.0], [0.0, -0.5]])
Q = np.diag([0.0, INTENSITY])


def draw() -> Figure:
    """Left: 1, 2 and 3 sigma, and when the tolerance is reached. Right: what it is made of, and a reverting one."""
    figure, (left, right) = panels(2, height=3.2)
    times = np.linspace(0.0, LONGEST_S, 201)
    sigma = _sigma(A, times)
    for k in (3, 2, 1):
        left.fill_between(times, -k * sigma, k * sigma, color=ON, alpha=0.16, lw=0)
        left.text(times[-1] + 0.06, k * sigma[-1], rf"{k} $\sigma$", color=ON, va="center")
    expiry = np.interp(TOLERANCE / 3.0, sigma, times)
    for side in (-1.0, 1.0):
        left.axhline(side * TOLERANCE, color=FORBIDDEN, lw=1.2)
    left.text(0.05, TOLERANCE + 0.08, "tolerance", color=FORBIDDEN)
    left.axvline(expiry, color=INK, lw=1.0, ls=":")
    left.text(expiry - 0.05, -1.75, f"permission\nexpires at {expiry:.2f} s", ha="right")
    left.set(xlim=(0.0, LONGEST_S + 0.35), ylabel="error of the position (m)")
    times = np.linspace(0.0, 8.0, 201)
    parts = (
        ("velocity, $\\sigma_v t$", np.sqrt(P0[1, 1]) * times, OTHER),
        ("noise, $\\sqrt{q t^3/3}$", np.sqrt(INTENSITY * times**3 / 3.0), OFF),
    )
    for label, part, color in parts:
        right.plot(times, part, color=color, ls="--", lw=1.3, label=label)
    right.plot(times, _sigma(A, times), color=ON, label="together")
    right.plot(times, _sigma(REVERTING, times), color=INK, label="velocity reverts in 2 s")
    right.axhline(0.0, color=GRID, lw=0.8)
    right.set_ylabel("$\\sigma$ of the position (m)")
    right.legend(loc="upper left")
    for ax in (left, right):
        ax.set_xlabel("time unseen (s)")
    return figure


def _sigma(system: Array, times: Array) -> Array:
    """Of the position, from P0 on."""
    steps = [discretise(system, Q, time) for time in times]
    return np.sqrt([(step.transition @ P0 @ step.transition.T + step.noise)[0, 0] for step in steps])
