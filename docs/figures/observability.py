"""Four ways to grow unseen, and what a distance alone tells of a place: at rest one direction never."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from _style import FORBIDDEN, INK, OFF, ON, OTHER, SAFE, panels
from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.covariance import discretise
from safe_wrappers.control.estimation.kalman import update

RATE = 0.5
"""1/s."""
STEPS = 40
NOISE = np.array([[0.05**2]])
"""m^2, of a measured distance."""


def draw() -> Figure:
    """Left: sigma over time. Right: three-sigma ellipses before and after many distances."""
    figure, (left, right) = panels(2, height=3.2)
    times = np.linspace(0.0, 6.0, 121)
    systems: tuple[tuple[str, list[list[float]], list[float], str], ...] = (
        ("exponential: unstable", [[RATE]], [0.02], FORBIDDEN),
        ("polynomial: noisy speed", [[0.0, 1.0], [0.0, 0.0]], [0.0, 0.02], OFF),
        ("linear variance: random walk", [[0.0]], [0.1], ON),
        ("bounded: returns to its mean", [[-RATE]], [0.1], SAFE),
    )
    for label, a, q, color in systems:
        start = 0.05**2 * np.eye(len(a))
        steps = [discretise(a, np.diag(q), time) for time in times]
        grown = [(step.transition @ start @ step.transition.T + step.noise)[0, 0] for step in steps]
        left.plot(times, np.sqrt(grown), color=color, label=label)
    left.set(ylim=(0.0, 2.6), xlabel="time unseen (s)", ylabel=r"$\sigma$")
    left.legend(loc="upper left")
    start = np.array([2.0, 1.5])
    for moves, color, label in ((0.0, OFF, "standing"), (1.0, ON, "moving")):
        cov = 0.3**2 * np.eye(2)
        for step in range(STEPS):
            place = start + moves * np.array([2.0 * step / STEPS, 0.0])  # known motion past the beacon
            gradient = (place / np.linalg.norm(place))[None]
            cov = update(np.zeros(2), cov, np.zeros(1), gradient, NOISE).cov
        _ellipse(right, start, cov, color, label)
    _ellipse(right, start, 0.3**2 * np.eye(2), OTHER, "before")
    right.plot(0.0, 0.0, "^", color=INK)
    right.text(0.15, -0.05, "beacon", va="center")
    right.plot([0.0, start[0]], [0.0, start[1]], color=INK, lw=0.8, ls=":")
    right.set(aspect="equal", xlim=(-0.3, 3.6), ylim=(-0.4, 3.0), xlabel="x (m)", ylabel="y (m)")
    right.legend(loc="upper left")
    return figure


def _ellipse(ax: Axes, center: Array, cov: Array, color: str, label: str) -> None:
    """Three standard deviations about the place at the start."""
    squares, axes = np.linalg.eigh(cov)
    width, height = 6.0 * np.sqrt(squares)
    angle = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    dashed = "--" if label == "before" else "-"
    ax.add_patch(
        Ellipse(
            (float(center[0]), float(center[1])),
            width,
            height,
            angle=angle,
            fill=False,
            edgecolor=color,
            ls=dashed,
            lw=1.6,
            label=label,
        )
    )
