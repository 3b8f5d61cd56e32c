"""An experiment's numbers: a row per arm, seed and condition, and interquartile means with intervals; its curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from safe_wrappers.errors import Array

from ..config.models import ArmConfig, ExperimentConfig, FilterConfig
from ..files import read_rows, write_json, write_rows
from ..run.folder import EVALUATION
from .evaluate import conditions
from .metrics import METRICS, OF_THE_FILTER, OF_THE_LEASE, RATES, TOTALS

CONDITIONS: Final = {
    "training": "Training, all episodes",
    "filter_off": "Evaluation, filter off",
    "filter_on": "Evaluation, filter on",
}
SEEDS_FOR_AN_INTERVAL: Final = 3
"""Fewer say nothing about others: their range is given, and called so."""
_MOST_BINS: Final = 40


@dataclass(frozen=True)
class Estimate:
    """The interquartile mean over seeds and its bootstrap 95 % interval.

    With two seeds `low` and `high` are their range, with one seed None.
    """

    iqm: float
    low: float | None
    high: float | None
    seeds: int

    def __str__(self) -> str:
        if self.low is None or self.high is None:
            return f"{number(self.iqm)} [n/a]"
        return f"{number(self.iqm)} [{number(self.low)}, {number(self.high)}]"


def spread(seeds: int) -> str:
    """What is given beside a mean over so many seeds: "", "range" or "95 % interval"."""
    if seeds < 2:
        return ""
    return "range" if seeds < SEEDS_FOR_AN_INTERVAL else "95 % interval"


def over_seeds(fewest: int, most: int) -> str:
    """What the numbers of a table are, and what stands in their brackets, by the seeds that are finished."""
    if most < 2:
        return "one seed, no interval"
    seeds = f"{most} seeds" if fewest == most else f"{fewest} to {most} seeds"
    if most < SEEDS_FOR_AN_INTERVAL:
        return f"mean over {seeds} [their range, not an interval]"
    rest = "" if fewest >= SEEDS_FOR_AN_INTERVAL else "; of two seeds their range"
    return f"interquartile mean over {seeds} [bootstrap 95 % interval{rest}]"


Table = dict[str, dict[str, dict[str, Estimate]]]
"""arm -> condition -> metric -> estimate."""


@dataclass(frozen=True)
class Summary:
    """The per-seed rows and what they come to."""

    per_seed: list[dict[str, Any]]
    table: Table

    @property
    def seeds(self) -> tuple[int, int]:
        """How many seeds a number is over, the fewest and the most; zeros where there is no number yet."""
        counts = [
            estimate.seeds
            for arm in self.table.values()
            for cell in arm.values()
            for estimate in cell.values()
        ]
        return min(counts, default=0), max(counts, default=0)

    @property
    def judged(self) -> bool:
        """Whether somebody judged: some row has violations, be it none of them."""
        return any("violations" in row for row in self.per_seed)


def interquartile_mean(values: ArrayLike, axis: int = -1) -> NDArray[np.float64]:
    """The mean of the middle half: a quarter of the values (rounded down) is cut at either end.

    With 1 to 3 values nothing is cut and it is the plain mean; with 4 or 5 the extremes go.
    """
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def estimate(values: Sequence[float]) -> Estimate:
    """Interquartile mean and 95 % percentile-bootstrap interval over seeds; of two seeds their range.

    The percentile method, because BCa is undefined when all seeds agree (as with zero violations) and
    unstable for a handful of seeds. With few seeds any bootstrap interval is too narrow; with two it would only be
    their range under another name.
    """
    iqm = float(interquartile_mean(values))
    if len(values) < 2:
        return Estimate(iqm, None, None, len(values))
    if len(values) < SEEDS_FOR_AN_INTERVAL or np.ptp(values) == 0:
        return Estimate(iqm, float(np.min(values)), float(np.max(values)), len(values))
    low, high = _bootstrap(np.asarray(values, dtype=float), 9999)
    return Estimate(iqm, float(low), float(high), len(values))


def _bootstrap(values: Array, resamples: int) -> tuple[Array, Array]:
    """The percentile interval over the first axis; the same values always give the same one."""
    generator = np.random.default_rng(0)
    interval = stats.bootstrap(
        (values,), interquartile_mean, axis=0, method="percentile", n_resamples=resamples, rng=generator
    ).confidence_interval
    return interval.low, interval.high


def summarize(experiment: ExperimentConfig) -> Summary:
    """Reads every run's rows and sums them up."""
    per_seed: list[dict[str, Any]] = []
    table: Table = {}
    for arm in experiment.arms:
        table[arm.name] = {}
        filters = {"training": arm.filter} | conditions(arm, experiment.evaluation_filter)
        for condition in CONDITIONS:
            used = filters.get(condition, FilterConfig())
            left_out = (*OF_THE_FILTER * (used.kind == "none"), *OF_THE_LEASE * (used.lease is None))
            metrics = [metric for metric in METRICS if metric not in left_out]
            rows = [
                {"arm": arm.name, "seed": seed, "condition": condition, **seed_row(episodes, metrics)}
                for seed in experiment.seeds
                if (episodes := read_rows(episode_file(experiment.run_folder(arm, seed), condition)))
            ]
            per_seed += rows
            table[arm.name][condition] = {
                metric: estimate([row[metric] for row in rows])
                for metric in metrics
                if rows and all(metric in row for row in rows)
            }
    return Summary(per_seed, table)


def write_summary(summary: Summary, folder: Path) -> None:
    """Writes `per_seed.csv` (one row per arm, seed and condition) and `summary.json`.

    What was not judged or not reported has no row in the summary and an empty cell in the seeds' table. `spread` says
    what `low` and `high` are: the range of two seeds, or an interval over more.
    """
    write_rows(
        folder / "per_seed.csv", ("arm", "seed", "condition", "episodes", "steps", *METRICS), summary.per_seed
    )
    plain = {
        arm: {
            condition: {
                metric: asdict(result) | {"spread": spread(result.seeds)}
                for metric, result in metrics.items()
            }
            for condition, metrics in conditions.items()
        }
        for arm, conditions in summary.table.items()
    }
    write_json(folder / "summary.json", plain)


def number(value: float) -> str:
    """Three significant digits, whole numbers in full, no exponents for everyday sizes."""
    if abs(value) >= 100 or value == int(value):
        return f"{value:,.0f}"
    return f"{value:.3g}"


def episode_file(run_folder: Path, condition: str) -> Path:
    """The table of a run's episodes under a condition."""
    if condition == "training":
        return run_folder / "episodes.csv"
    return run_folder / EVALUATION / f"{condition}.csv"


def seed_row(episodes: Sequence[Mapping[str, float]], metrics: Sequence[str]) -> dict[str, Any]:
    """What a run's episodes come to: `episodes`, `steps`, and those metrics that all of them report."""
    steps = sum(episode["length"] for episode in episodes)
    row: dict[str, Any] = {"episodes": len(episodes), "steps": int(steps)}
    for metric in metrics:
        source, per = RATES.get(metric, (metric, 1.0))
        if all(source in episode for episode in episodes):
            values = [episode[source] for episode in episodes]
            if metric in RATES:
                row[metric] = per * float(np.sum(values)) / steps
            else:
                row[metric] = float(np.sum(values) if metric in TOTALS else np.mean(values))
    return row


def judged_by(experiment: ExperimentConfig, judged: bool) -> str:
    """Who judges, in a sentence; empty where it is the task itself. `judged`: whether a cost was reported at all."""
    if not judged:
        return (
            "Violations are not judged: the task reports no cost. A judge for it is env.cost (module:function) or"
            " env.judge (constraints) in the config, under another name of the experiment."
        )
    functions = list(dict.fromkeys(arm.env.cost for arm in experiment.arms if arm.env.cost is not None))
    if functions:
        return f"Violations are judged by {' and '.join(functions)} at the end of each step, not by the task."
    if any(arm.env.judge is not None for arm in experiment.arms):
        return (
            "Violations are judged by the filter's own limits (a constraint's h below 0 in the true state at the end"
            " of a step), with the filter on and off; the task itself reports no cost."
        )
    return ""


@dataclass(frozen=True)
class Curve:
    """One arm's metric over B bins of steps."""

    steps: Array  # middles of the bins, shape (B,)
    iqm: Array  # over seeds, shape (B,)
    low: Array | None  # the interval's lower end, of two seeds the range's, shape (B,); None of one seed
    high: Array | None
    seeds: Array  # each seed's own, shape (seeds, B)


def learning_curve(experiment: ExperimentConfig, arm: ArmConfig, metric: str) -> Curve | None:
    """Means over equal bins of steps, as many as leave no seed without an episode in one (at most 40).

    Returns:
        The curve, or None when some seed has no episode with that metric.
    """
    runs = []
    for seed in experiment.seeds:
        rows = read_rows(experiment.run_folder(arm, seed) / "episodes.csv")
        points = [(row["timesteps"], row[metric]) for row in rows if metric in row]
        runs.append(np.array(points).reshape(-1, 2))
    if not all(len(run) for run in runs):
        return None
    end = max(run[-1, 0] for run in runs)
    for bins in range(_MOST_BINS, 0, -1):
        edges = np.linspace(0, end, bins + 1)
        # A bin's right end is its own; steps are whole numbers.
        binned = [stats.binned_statistic(run[:, 0] - 0.5, run[:, 1], "mean", edges) for run in runs]
        means = np.array([bins_of_run.statistic for bins_of_run in binned])
        if np.isfinite(means).all():
            break
    low = high = None
    if len(means) >= SEEDS_FOR_AN_INTERVAL:
        low, high = _bootstrap(means, 2000)
    elif len(means) > 1:
        low, high = means.min(axis=0), means.max(axis=0)
    return Curve((edges[:-1] + edges[1:]) / 2, interquartile_mean(means, axis=0), low, high, means)
