"""Simulated turning targets, seen for two seconds and then not: the share outside k sigma of what tracks claim.

    python -m benchmarks.turns     # half a minute; table to benchmarks/results/turns.md

5,000 targets at 1 m/s with turn rates of 1 rad/s (standard deviation), moved by Heun's rule in steps of 2 ms with the
noises that the tracks are told of. The other track is told of all but the turn.
"""

from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.tables import RESULTS
from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.tracks import Motion, Tracks, largest_deviation
from safe_wrappers.control.estimation.turning_tracks import TurningTracks

TURNING = Motion(np.diag([0.01, 0.01]), np.inf, np.zeros(2), 0.05)
TARGETS = 5000
STEP_S, SEEN_S, POSITION_STD = 0.02, 2.0, 0.02
UNSEEN_S = (0.5, 1.0, 2.0)
KS = (1, 2, 3)


def moved(rng: np.random.Generator, states: Array, time_s: float, dt: float = 0.002) -> Array:
    """True states (n, 5) after a time."""
    root = np.sqrt(np.append(np.diag(TURNING.intensity), TURNING.turn_noise) * dt)

    def slope(x: Array) -> Array:
        return np.stack([x[:, 2], x[:, 3], -x[:, 4] * x[:, 3], x[:, 4] * x[:, 2], 0.0 * x[:, 4]], axis=1)

    for _ in range(round(time_s / dt)):
        guess = states + dt * slope(states)
        states = states + 0.5 * dt * (slope(states) + slope(guess))
        states[:, 2:] += root * rng.normal(size=(len(states), 3))
    return states


def outside(tracks: Tracks, truth: Array, k: float) -> float:
    """Share of the targets that are outside k sigma."""
    off = (truth[:, :2] - tracks.positions)[:, :, None]
    squared = (off.swapaxes(1, 2) @ np.linalg.solve(tracks.position_covariances, off)).ravel()
    return float((squared > k * k).mean())


def main() -> None:
    """Simulate, print, write."""
    rng = np.random.default_rng(11)
    truth = np.zeros((TARGETS, 5))
    heading = rng.uniform(0.0, 2.0 * np.pi, TARGETS)
    truth[:, 2:4] = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    truth[:, 4] = rng.normal(0.0, 1.0, TARGETS)
    start = np.diag([0.05, 0.05, 0.7, 0.7, 1.0]) ** 2
    turning = TurningTracks([TURNING] * TARGETS)
    straight = Tracks([TURNING._replace(turn_noise=None)] * TARGETS)
    turning.start(np.zeros((TARGETS, 5)), np.tile(start, (TARGETS, 1, 1)))
    straight.start(np.zeros((TARGETS, 4)), np.tile(start[:4, :4], (TARGETS, 1, 1)))
    told: dict[str, Any] = {"turning": turning, "straight": straight}
    for _ in range(round(SEEN_S / STEP_S)):
        truth = moved(rng, truth, STEP_S)
        measured = truth[:, :2] + POSITION_STD * rng.normal(size=(TARGETS, 2))
        for tracks in told.values():
            tracks.advance(STEP_S)
            tracks.see(np.arange(TARGETS), measured, np.eye(2, 4), POSITION_STD**2 * np.eye(2))
    tail = " | ".join(f"{p:.2%}" for p in chi2.sf(np.square(KS, dtype=np.float64), 2))
    lines = ["| track | not seen for | k = 1 | k = 2 | k = 3 | mean sigma (m) |", "|---|---|---|---|---|---|"]
    lines.append(f"| promised, normal, in the plane | - | {tail} | - |")
    before = 0.0
    for unseen_s in (0.0, *UNSEEN_S):
        truth = moved(rng, truth, unseen_s - before)
        for name, tracks in told.items():
            tracks.advance(unseen_s - before)
            shares = " | ".join(f"{outside(tracks, truth, k):.2%}" for k in KS)
            sigma = largest_deviation(tracks.position_covariances).mean()
            lines.append(f"| {name} | {unseen_s:g} s | {shares} | {sigma:.3f} |")
        before = unseen_s
    (RESULTS / "turns.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
