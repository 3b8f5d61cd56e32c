"""What is not seen: how true the estimates' covariances are, and what keeping clear of them is worth.

    python -m benchmarks.occlusion                      # all three parts, about an hour on two cores
    python -m benchmarks.occlusion consistency          # 1,000 episodes: errors against their covariances
    python -m benchmarks.occlusion growth               # sigma while nothing is seen against its closed form
    python -m benchmarks.occlusion collisions --steps 100000   # per driver and filter
    python -m benchmarks.occlusion collisions --steps 2000     # a look

OccludedCrossing, with the sensor and tracks of its trainings (benchmarks/tracked.py). The truth is the env's: the
states of its cars, and its own judge of collisions at every physics substep. Estimates are the wrapper's. Every part
puts its rows into benchmarks/results/occlusion.jsonl in place of its old ones, and the tables of all parts that are
there make benchmarks/results/occlusion.md.
"""

import argparse
import itertools
import json
import math
import multiprocessing
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

import safe_wrappers as sw
from benchmarks.crossing_drivers import DRIVERS
from benchmarks.tables import RESULTS, markdown, total
from benchmarks.tracked import CROSSING, crossing
from safe_wrappers.checks import Array
from safe_wrappers.errors import UnsafeStateWarning

ENV_ID = "OccludedCrossing-v0"
STATE = [0, 2]
"""Of a track: position and velocity along the lane; across it a car does not move, and that is known."""
PHASES = {"seen": (0.04, 0.2, 1.0, 2.0), "unseen": (0.04, 0.2, 0.5, 1.0, 2.0, 4.0)}
"""Times after the sight came or went at which an error is looked at, s."""
TURNED_AT_S, TURNED_S = 4.0, 1.0
"""When the robot of the scheduled episodes looks away, and how long that takes it, s."""
BLIND_S = (0.0, 0.5, 1.0, 2.0, 4.0)
KS = (1, 2, 3)
ARMS: dict[str, dict[str, Any] | None] = {
    "no filter": None,
    "last seen": {"cars": "last_seen"},
    "true state": {"cars": "true"},
    **{f"estimate, k = {k}": {"cars": "estimated", "sigmas": float(k)} for k in KS},
}
WARNED_STEPS = 25
"""A collision is announced if a step of the last second was flagged."""
EPISODES = 25
"""Of one job."""


# 1. Consistency ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Episode:
    """What one episode's tracks were, and what they were taken for; steps, then six cars.

    Attributes:
        error: True minus estimated position and velocity along the lane, shape (n, 6, 2), m and m/s.
        covariance: That is claimed, shape (n, 6, 2, 2).
        visible: Shape (n, 6).
        step_s: s.
    """

    error: Array
    covariance: Array
    visible: NDArray[np.bool_]
    step_s: float


def episode(seed: int, scheduled: bool, steps: int | None = None, **changes: Any) -> Episode:
    """Drive one episode without a filter.

    Args:
        seed: Of env and driver.
        scheduled: The robot stands, looks at the road and then turns its back to it at a time that has nothing to do
            with the cars; else it crosses.
        steps: How many; None: the whole episode.
        changes: Of the wrapper's settings.
    """
    env = crossing(gym.make(ENV_ID), **changes)
    raw: Any = env.unwrapped
    start = {"agent": [0.0, -2.9, 0.5 * math.pi]}
    env.reset(seed=seed, options={"layout": start} if scheduled else None)
    act = DRIVERS["goal-seeking"](raw, np.random.default_rng(seed))
    errors, covariances, visible = [], [], []
    step_s, last = float(raw.dt), env.get_wrapper_attr("spec").max_episode_steps
    for step in range(steps or last):
        action = act()
        if scheduled:
            heading = 0.5 * math.pi if step * step_s < TURNED_AT_S else -0.5 * math.pi
            turn = math.remainder(heading - raw.agent_heading, math.tau)
            action = np.array([0.0, 0.0, float(np.clip(2.0 * turn, -1.0, 1.0))])
        info = env.step(action)[4]
        truth = np.stack([raw.car_positions[:, 0], raw.car_velocities[:, 0]], axis=1)
        errors.append(truth - env.tracking.mean[:, STATE])
        covariances.append(env.tracking.covariance[:, STATE][:, :, STATE])
        visible.append(info["occlusion/visible"])
    return Episode(np.array(errors), np.array(covariances), np.array(visible), step_s)


def phases(visible: NDArray[np.bool_]) -> list[tuple[int, int, bool]]:
    """Runs of equal sight in one track's steps (n,) but the first: first step, length, whether seen."""
    changes = np.flatnonzero(np.diff(visible)) + 1
    ends = [*changes, len(visible)][1:]
    return [(int(a), int(b - a), bool(visible[a])) for a, b in zip(changes, ends, strict=True)]


def nees_samples(found: Episode, rng: np.random.Generator) -> dict[str, float]:
    """At most one sample per phase and time: of one track, in the first of its phases that lasts long enough.

    A phase lasts as long as the car takes, so which phase lasts depends on the very error: a car that stays hidden is
    slower than it was taken for. The scheduled episodes are free of this.
    """
    samples = {}
    order = rng.permutation(found.visible.shape[1])
    for seen, times in ((True, PHASES["seen"]), (False, PHASES["unseen"])):
        for time_s in times:
            after = round(time_s / found.step_s)
            for track in order:
                at = next(
                    (a for a, n, s in phases(found.visible[:, track]) if s == seen and n >= after and n > 0),
                    None,
                )
                if at is not None:
                    index = at + after - 1
                    key = f"{'seen' if seen else 'unseen'} for {time_s:g} s"
                    samples[key] = _nees(found, index, int(track))
                    break
    return samples


def scheduled_samples(found: Episode, run: int) -> dict[str, float]:
    """One track's error at fixed times, whatever was seen; from the turn on nothing is."""
    track = run % found.visible.shape[1]
    samples = {}
    for time_s in (1.0, 2.0, 4.0):
        samples[f"{time_s:g} s after the reset"] = _nees(found, round(time_s / found.step_s) - 1, track)
    for time_s in PHASES["unseen"]:
        index = round((TURNED_AT_S + TURNED_S + time_s) / found.step_s) - 1
        samples[f"turned away for {time_s:g} s"] = _nees(found, index, track)
    return samples


def _nees(found: Episode, index: int, track: int) -> float:
    error = found.error[index, track]
    return float(error @ np.linalg.solve(found.covariance[index, track], error))


def blind_for(found: Episode) -> Array:
    """How long each track has not been seen, s, 0 where it is; from the reset on, if it never was."""
    blind = np.zeros(found.visible.shape)
    for step, seen in enumerate(found.visible):
        before = blind[step - 1] if step else np.zeros(len(seen))
        blind[step] = np.where(seen, 0.0, before + found.step_s)
    return blind


def violations(found: Episode) -> dict[str, list[int]]:
    """Track-steps, and in how many of them the error is beyond 1, 2 and 3 sigma, by what was seen."""
    size = np.abs(found.error[..., 0]) / np.sqrt(found.covariance[..., 0, 0])
    blind = blind_for(found)
    groups = {"seen": found.visible}
    groups |= {f"unseen for more than {s:g} s" if s else "unseen": blind > s + 1e-9 for s in BLIND_S}
    return {name: [int(of.sum()), *(int((size[of] > k).sum()) for k in KS)] for name, of in groups.items()}


def consistency_job(first: int, count: int) -> list[dict[str, Any]]:
    """Episodes with the seeds from `first` on, in both modes."""
    rows = []
    for seed in range(first, first + count):
        driven = episode(seed, scheduled=False)
        turned = episode(seed, scheduled=True, steps=round((TURNED_AT_S + TURNED_S + 4.0) / 0.04))
        samples = nees_samples(driven, np.random.default_rng(seed)) | scheduled_samples(turned, seed)
        after = round((TURNED_AT_S + TURNED_S) / turned.step_s)
        away = Episode(turned.error[after:], turned.covariance[after:], turned.visible[after:], turned.step_s)
        scheduled = violations(away)["unseen"]
        outside = violations(driven) | {"turned away, by schedule": scheduled}
        seen_after = int(away.visible.sum())
        rows.append({"part": "consistency", "seed": seed, "nees": samples, "violations": outside})
        rows[-1]["seen_when_turned_away"] = seen_after
    return rows


def consistency_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: NEES per phase with its band, then shares beyond k sigma with what is promised."""
    lines = [
        "Normalised error squared of position and velocity along the lane, one sample per independent episode:",
        "",
        "| phase | episodes | mean | 95 % band | inside | beyond 95 % of chi-square |",
        "|---|---|---|---|---|---|",
    ]
    names = list(dict.fromkeys(name for row in rows for name in row["nees"]))
    upper = chi2.ppf(0.95, 2)
    for name in sorted(names, key=_phase_order):
        values = np.array([row["nees"][name] for row in rows if name in row["nees"]])
        low, high = chi2.interval(0.95, 2 * len(values), scale=1.0 / len(values))
        inside = low <= values.mean() <= high
        lines.append(
            f"| {name} | {len(values):,} | {values.mean():.3f} | {low:.3f} to {high:.3f} "
            f"| {'yes' if inside else '**no**'} | {(values > upper).mean():.1%} |"
        )
    lines += [
        "",
        "Track-steps in which the true position is beyond k sigma, and twice the standard error over episodes:",
        "",
        "| sight | track-steps | k = 1 | k = 2 | k = 3 | k = 3, per million |",
        "|---|---|---|---|---|---|",
    ]
    for name in rows[0]["violations"]:
        counts = np.array([row["violations"][name] for row in rows], dtype=np.float64)
        cells, total = [], counts.sum(axis=0)
        for i in range(1, len(KS) + 1):
            share = total[i] / max(total[0], 1.0)
            # Steps of an episode are not independent, episodes are: a ratio estimate's error.
            spread = math.sqrt(((counts[:, i] - share * counts[:, 0]) ** 2).sum()) / max(total[0], 1.0)
            cells.append(f"{share:.2%} ± {2.0 * spread:.2%}")
        million = 1e6 * total[3] / max(total[0], 1.0)
        lines.append(f"| {name} | {int(total[0]):,} | {' | '.join(cells)} | {million:,.0f} |")
    squares = np.square(KS, dtype=np.float64)
    for name, shares in (
        ("promised, Gaussian", chi2.sf(squares, 1)),
        ("promised, any distribution", 1.0 / squares),
    ):
        lines.append(f"| {name} | - | {' | '.join(f'{s:.2%}' for s in shares)} | {1e6 * shares[-1]:,.0f} |")
    seen = sum(row["seen_when_turned_away"] for row in rows)
    return "\n".join([*lines, "", f"Track-steps seen while the robot was turned away: {seen}."])


def _phase_order(name: str) -> tuple[int, float]:
    kinds = ("seen", "unseen", "turned away", "")
    kind = next(i for i, start in enumerate(kinds) if name.startswith(start))
    return kind, next(float(word) for word in name.split() if word.replace(".", "").isdigit())


# 2. Growth ---------------------------------------------------------------------------------------------------------


def reverting_sigma(start: Array, intensity: float, reversion_s: float, times: Array) -> Array:
    """Standard deviation of a position whose velocity goes back to its mean, after times without a measurement, m.

    The closed form in extended precision: over short times it is a difference of nearly equal numbers.
    """
    wide = np.longdouble
    t, tau, q = times.astype(wide), wide(reversion_s), wide(intensity)
    lost, twice = -np.expm1(-t / tau), -np.expm1(-2 * t / tau)
    way = tau * lost
    p = start.astype(wide)
    noise = q * tau**2 * (t - 2 * tau * lost + tau * twice / 2)
    return np.asarray(np.sqrt(p[0, 0] + 2 * way * p[0, 1] + way**2 * p[1, 1] + noise), dtype=np.float64)


def growth_job(seed: int) -> list[dict[str, Any]]:
    """Largest relative error of sigma over all unseen stretches of an episode, for both motions of a track."""
    found_rows = []
    for reversion_s in (2.0, None):
        tracks = [track | {"reversion_s": reversion_s} for track in CROSSING["tracks"]]
        found = episode(seed, scheduled=False, tracks=tracks)
        intensity = float(tracks[0]["acceleration_noise"][0])
        worst, longest, steps = 0.0, 0.0, 0
        for track in range(found.visible.shape[1]):
            for first, count, seen in phases(found.visible[:, track]):
                if seen:
                    continue
                start = found.covariance[first - 1, track]
                times = found.step_s * np.arange(1, count + 1)
                sigma = np.sqrt(found.covariance[first : first + count, track, 0, 0])
                if reversion_s is None:
                    (p, both), (_, v) = start
                    form = np.sqrt(p + 2 * both * times + v * times**2 + intensity * times**3 / 3)
                else:
                    form = reverting_sigma(start, intensity, reversion_s, times)
                worst = max(worst, float(np.abs(sigma / form - 1.0).max()))
                longest, steps = max(longest, count * found.step_s), steps + count
        motion = "double integrator" if reversion_s is None else "reverting velocity"
        row = {"part": "growth", "seed": seed, "motion": motion, "worst": worst, "longest_s": longest}
        found_rows.append(row | {"steps": steps})
    return found_rows


def growth_table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = []
    for motion in dict.fromkeys(row["motion"] for row in rows):
        part = [row for row in rows if row["motion"] == motion]
        longest, worst = (max(r[key] for r in part) for key in ("longest_s", "worst"))
        lines.append([motion, f"{total(part, 'steps'):,}", f"{longest:.2f}", f"{worst:.1e}"])
    says = "Sigma of a position while it is not seen, the wrapper's step by step against the closed form:"
    head = "motion of a track | unseen track-steps | longest (s) | largest relative error"
    return f"{says}\n\n{markdown(head, lines)}"


# 3. Collisions -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One driver under one filter for so many steps."""

    driver: str
    arm: str
    steps: int
    seed: int


def collisions_job(job: Job) -> list[dict[str, Any]]:
    """Drive, count."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted below
    env: Any = crossing(gym.make(ENV_ID))
    raw = env.unwrapped
    options = ARMS[job.arm]
    if options is not None:
        env = sw.protect(env, **options)
    rng = np.random.default_rng(job.seed)
    act = DRIVERS[job.driver](raw, rng)
    names = ("collisions", "unflagged", "unannounced", "cost_steps", "goals", "intervened", "flagged")
    count = dict.fromkeys(names, 0)
    done, number, since = True, 0, WARNED_STEPS
    for _ in range(job.steps):
        if done:
            _, info = env.reset(seed=100_000 * job.seed + number)
            number, since = number + 1, WARNED_STEPS
        _, _, terminated, truncated, info = env.step(np.asarray(act(), dtype=env.action_space.dtype))
        done = terminated or truncated
        flagged = options is not None and bool(
            info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"]
        )
        since = 0 if flagged else since + 1
        begun = info["collisions"]
        count["collisions"] += begun
        count["unflagged"] += begun * (not flagged)
        count["unannounced"] += begun * (since >= WARNED_STEPS)
        count["cost_steps"] += info["cost"] > 0.0
        count["goals"] += info["goal_met"]
        count["flagged"] += flagged
        count["intervened"] += options is not None and bool(info["cbf/intervened"])
    return [{"part": "collisions"} | asdict(job) | {name: int(value) for name, value in count.items()}]


def collisions_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a row per filter and driver, and one per filter over all drivers."""
    lines = []
    present = list(dict.fromkeys(row["driver"] for row in rows))
    for driver, arm in itertools.product([*present, "all"], ARMS):
        part = [r for r in rows if r["arm"] == arm and driver in (r["driver"], "all")]
        if not part:
            continue
        count = {k: total(part, k) for k in part[0] if isinstance(part[0][k], int)}
        steps = count["steps"]
        filtered = ARMS[arm] is not None
        cells = [arm, driver, f"{steps:,}", f"{count['collisions']:,}"]
        cells.append(f"{1e6 * count['collisions'] / steps:,.0f}")
        cells += [str(count[k]) if filtered else "-" for k in ("unflagged", "unannounced")]
        cells.append(f"{count['cost_steps']:,}")
        cells += [f"{count[k] / steps:.2%}" if filtered else "-" for k in ("intervened", "flagged")]
        cells.append(f"{1e3 * count['goals'] / steps:.2f}")
        lines.append(cells)
    says = "Collisions under drivers that know nothing of cars, judged by the env on the truth:"
    head = "filter | driver | steps | collisions | per million steps | in a step not flagged"
    more = "with no flag in the second before | steps in contact | changed | flagged | goals / 1,000 steps"
    return f"{says}\n\n{markdown(f'{head} | {more}', lines)}"


# All of it ---------------------------------------------------------------------------------------------------------

TABLES: dict[str, Callable[[list[dict[str, Any]]], str]] = {
    "consistency": consistency_table,
    "growth": growth_table,
    "collisions": collisions_table,
}


def jobs(
    part: str, episodes: int, steps: int
) -> list[tuple[Callable[..., list[dict[str, Any]]], tuple[Any, ...]]]:
    """What a part consists of."""
    if part == "consistency":
        starts = range(0, episodes, EPISODES)
        return [(consistency_job, (first, min(EPISODES, episodes - first))) for first in starts]
    if part == "growth":
        return [(growth_job, (seed,)) for seed in range(min(episodes, 40))]
    size = min(steps, 5_000)
    return [
        (collisions_job, (Job(driver, arm, min(size, steps - at), at // size),))
        for at in range(0, steps, size)
        for driver in DRIVERS
        for arm in ARMS
    ]


def _do(job: tuple[Callable[..., list[dict[str, Any]]], tuple[Any, ...]]) -> list[dict[str, Any]]:
    call, given = job
    return call(*given)


def main() -> None:
    """Run the parts that are asked for, keep every row as it comes, write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], help=f"of {', '.join(TABLES)}; none: all")
    parser.add_argument(
        "--episodes", type=int, default=1000, help="of consistency and (at most 40) of growth"
    )
    parser.add_argument("--steps", type=int, default=100_000, help="of collisions, per driver and filter")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    parts = arguments.parts or list(TABLES)
    for part in parts:
        if part not in TABLES:
            parser.error(f"there is no part {part!r}; there are {', '.join(TABLES)}")
    arguments.results.mkdir(parents=True, exist_ok=True)
    path = arguments.results / "occlusion.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [row for row in map(json.loads, lines) if row["part"] not in parts]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool, path.open("a") as file:
        for part in parts:
            for found in pool.imap(_do, jobs(part, arguments.episodes, arguments.steps)):
                rows += found
                file.writelines(json.dumps(row) + "\n" for row in found)
                file.flush()
    tables = [
        table([r for r in rows if r["part"] == p])
        for p, table in TABLES.items()
        if any(r["part"] == p for r in rows)
    ]
    (arguments.results / "occlusion.md").write_text("\n\n".join(tables) + "\n")
    print("\n\n".join(tables))


if __name__ == "__main__":
    main()
