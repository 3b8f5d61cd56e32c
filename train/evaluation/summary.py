"""An experiment's numbers: a row per arm, seed and condition, and interquartile means with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from ..config import ExperimentConfig, FilterConfig
from ..files import read_rows, write_json, write_rows
from .evaluate import conditions, evaluation_folder
from .has_cost import evaluated_without_cost
from .metrics import METRICS, OF_THE_FILTER, OF_THE_JUDGE, OF_THE_LEASE, RATES, TOTALS

CONDITIONS: Final = {
    "training": "Training, all episodes",
    "filter_off": "Evaluation, filter off",
    "filter_on": "Evaluation, filter on",
}
SEEDS_FOR_AN_INTERVAL: Final = 3
"""Fewer say nothing about others: their range is given, and called so."""


@dataclass(frozen=True)
class Estimate:
    """The interquartile mean over seeds and its bootstrap 95 % interval.

    With two seeds `low` and `high` are their range, with one seed None.
    """

    iqm: float
    low: float | None
    high: float | None
    seeds: int

    @property
    def spread(self) -> str:
        """What `low` and `high` are."""
        return spread(self.seeds)

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
    interval = stats.bootstrap(
        (np.asarray(values, dtype=float),),
        interquartile_mean,
        method="percentile",
        n_resamples=9999,
        rng=np.random.default_rng(0),  # the same rows always give the same interval
    ).confidence_interval
    return Estimate(iqm, float(interval.low), float(interval.high), len(values))


def summarize(experiment: ExperimentConfig) -> Summary:
    """Reads every run's rows and sums them up.

    Raises:
        RunStateError: A table is unreadable.
    """
    per_seed: list[dict[str, Any]] = []
    table: Table = {}
    for arm in experiment.arms:
        table[arm.name] = {}
        filters = {"training": arm.filter} | conditions(arm, experiment.evaluation_filter)
        unjudged = OF_THE_JUDGE if evaluated_without_cost(experiment, arm) else ()
        for condition in CONDITIONS:
            used = filters.get(condition, FilterConfig())
            left_out = (OF_THE_FILTER if used.kind == "none" else ()) + (
                OF_THE_LEASE if used.lease is None else ()
            )
            metrics = [metric for metric in METRICS if metric not in (*left_out, *unjudged)]
            rows = []
            for seed in experiment.seeds:
                episodes = read_rows(episode_file(experiment.run_folder(arm, seed), condition))
                if episodes:
                    rows.append(
                        {
                            "arm": arm.name,
                            "seed": seed,
                            "condition": condition,
                            **seed_row(episodes, metrics),
                        }
                    )
            per_seed += rows
            table[arm.name][condition] = {
                metric: estimate([row[metric] for row in rows])
                for metric in metrics
                if rows and all(metric in row for row in rows)
            }
    return Summary(per_seed, table)


def write_summary(summary: Summary, folder: Path) -> None:
    """Writes `per_seed.csv` (one row per arm, seed and condition), `summary.csv` and `summary.json`.

    What was not judged or not reported has no row in the summary and an empty cell in the seeds' table. `spread` says
    what `low` and `high` are: the range of two seeds, or an interval over more.
    """
    write_rows(
        folder / "per_seed.csv", ("arm", "seed", "condition", "episodes", "steps", *METRICS), summary.per_seed
    )
    rows = [
        {"arm": arm, "condition": condition, "metric": metric}
        | {key: "" if value is None else value for key, value in _plain(result).items()}
        for arm, conditions in summary.table.items()
        for condition, metrics in conditions.items()
        for metric, result in metrics.items()
    ]
    write_rows(
        folder / "summary.csv", ("arm", "condition", "metric", "iqm", "low", "high", "seeds", "spread"), rows
    )
    write_json(
        folder / "summary.json",
        {
            arm: {
                condition: {metric: _plain(result) for metric, result in metrics.items()}
                for condition, metrics in conditions.items()
            }
            for arm, conditions in summary.table.items()
        },
    )


def _plain(result: Estimate) -> dict[str, Any]:
    return asdict(result) | {"spread": result.spread}


def number(value: float) -> str:
    """Three significant digits, whole numbers in full, no exponents for everyday sizes."""
    if abs(value) >= 100 or value == int(value):
        return f"{value:,.0f}"
    return f"{value:.3g}"


def episode_file(run_folder: Path, condition: str) -> Path:
    """The table of a run's episodes under a condition."""
    if condition == "training":
        return run_folder / "episodes.csv"
    return evaluation_folder(run_folder) / f"{condition}.csv"


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
