"""Patrols that turn about, and what a track must be told for them to stay within its bound.

    python -m benchmarks.patrols                  # 20,000 steps per track, about twenty minutes on one core
    python -m benchmarks.patrols --steps 1000     # a look

PatrolledPointMaze under a driver that goes at the nearest patrol. The patrols, their turns and the judge of
collisions are the env's. Beside collisions it counts how often a patrol's true position is outside three standard
deviations of its estimate, now and as it was foretold half a second before: the filter decides by what is foretold.
"""

import argparse
import json
import warnings
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.patrol_drivers import patrol_seeking
from benchmarks.tables import RESULTS, markdown
from benchmarks.tracked import PATROLLED, PATROLS_AT_ONCE, PATROLS_TURNING, PATROLS_TURNING_AT_ONCE, patrolled
from safe_wrappers.errors import UnsafeStateWarning

SIGMAS = 3.0
AHEAD_S = 0.5
EPISODE_STEPS = 1000
ARMS: dict[str, tuple[dict[str, Any], bool]] = {
    "no filter": (PATROLLED, False),
    "speed goes back in 2 s": (PATROLLED, True),
    "coordinated turns, speed goes back in 2 s": (PATROLS_TURNING, True),
    "speed goes back in 0.25 s": (PATROLS_AT_ONCE, True),
    "coordinated turns, speed goes back in 0.25 s": (PATROLS_TURNING_AT_ONCE, True),
}
"""Settings of the OcclusionPenalty, and whether there is a filter."""


def drive(arm: str, steps: int, seed: int = 0) -> dict[str, Any]:
    """Count what happens in so many steps of one arm."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted below
    settings, filtered = ARMS[arm]
    tracked = patrolled(gym.make("PatrolledPointMaze-v0"), **settings)
    env: Any = sw.protect(tracked, sigmas=SIGMAS) if filtered else tracked
    raw: Any = env.unwrapped
    act = patrol_seeking(raw, np.random.default_rng(seed))
    lag = round(AHEAD_S / raw.dt)
    names = (
        "collisions",
        "unflagged",
        "outside",
        "outside_ahead",
        "judged",
        "judged_ahead",
        "changed",
        "flagged",
    )
    count = dict.fromkeys(names, 0)
    for step in range(steps):
        if step % EPISODE_STEPS == 0:
            env.reset(seed=100_000 * seed + step // EPISODE_STEPS)
            foretold: deque[Any] = deque(maxlen=lag)
        if len(foretold) == lag:
            position, covariance = foretold.popleft()
        else:
            position = None
        there, spread = tracked.tracking.ahead([AHEAD_S])
        foretold.append((there[0], spread[0]))
        info = env.step(np.asarray(act(), dtype=env.action_space.dtype))[4]
        flagged = filtered and bool(info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"])
        count["collisions"] += info["collisions"]
        count["unflagged"] += info["collisions"] * (not flagged)
        count["flagged"] += flagged
        count["changed"] += filtered and bool(info["cbf/intervened"])
        truth = raw.patrol_positions
        now = tracked.tracking.positions, tracked.tracking.position_covariances
        count["outside"] += _outside(truth, *now)
        count["judged"] += len(truth)
        if position is not None:
            count["outside_ahead"] += _outside(truth, position, covariance)
            count["judged_ahead"] += len(truth)
    return {"arm": arm, "steps": steps, "seed": seed} | {name: int(value) for name, value in count.items()}


def _outside(truth: Any, position: Any, covariance: Any) -> int:
    """How many are farther off along the corridor, x, than the bound."""
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0], 0.0))
    return int((np.abs(truth[:, 0] - position[:, 0]) > SIGMAS * sigma).sum())


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown, a row per arm."""
    lines = []
    for row in rows:
        filtered, steps = ARMS[row["arm"]][1], row["steps"]
        cells = [row["arm"], f"{steps:,}", str(row["collisions"]), str(row["unflagged"]) if filtered else "-"]
        cells.append(f"{row['outside'] / row['judged']:.2%}")
        cells.append(f"{row['outside_ahead'] / row['judged_ahead']:.2%}")
        cells += [f"{row[name] / steps:.1%}" if filtered else "-" for name in ("changed", "flagged")]
        lines.append(cells)
    return markdown(
        f"the track is told | steps | collisions | not flagged | outside {SIGMAS:g} sigma, now | the same, "
        f"{AHEAD_S:g} s ahead | changed | flagged",
        lines,
    )


def main() -> None:
    """Run the arms that are asked for, in place of their old rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000, help="per arm")
    parser.add_argument("--arms", nargs="*", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    path = arguments.results / "patrols.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    rows = {row["arm"]: row for row in map(json.loads, lines)}
    for arm in arguments.arms:
        rows[arm] = drive(arm, arguments.steps)
        ordered = [rows[name] for name in ARMS if name in rows]
        path.write_text("".join(json.dumps(row) + "\n" for row in ordered))
        (arguments.results / "patrols.md").write_text(table(ordered) + "\n")
    print(table(ordered))


if __name__ == "__main__":
    main()
