"""An experiment's numbers: a row per arm, seed and condition, and interquartile means with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from .atomic import write_json
from .config import ExperimentConfig, FilterConfig
from .evaluate import evaluation_folder
from .tables import read_rows, write_rows

CONDITIONS: Final = {
    "training": "Training, all episodes",
    "filter_off": "Evaluation, filter off",
    "filter_on": "Evaluation, filter on",
}
TOTALS: Final = (
    "violations",
    "infeasible",
    "fallback",
    "unsafe",
    "lease_braking",
    "lease_expired",
    "spin_outs",
    "collisions",
    "expiries",
)
METRICS: Final = {
    "return": "Return / episode",
    "length": "Steps / episode",
    "cost": "Cost / episode",
    "cost_substep": "Cost in substeps / episode",
    "violations": "Steps in violation, total",
    "violations_per_1000": "Steps in violation / 1000",
    "intervention_rate": "Share of steps changed",
    "correction_mean": "Correction, mean",
    "correction_p95": "Correction, 95th pct.",
    "infeasible": "Infeasible steps, total",
    "infeasible_per_1000": "Infeasible steps / 1000",
    "fallback": "Fallback steps, total",
    "unsafe": "Steps begun with h < 0, total",
    "lease_braking": "Steps braked by the lease, total",
    "lease_expired": "Leases run out, total",
    "goals_reached": "Goals / episode",
    "spin_outs": "Steps in spin-out, total",
    "spin_outs_per_million": "Steps in spin-out / million",
    "collisions": "Collisions, total",
    "collisions_per_million": "Collisions / million steps",
    "seen": "Share of time that a track is seen",
    "expiries": "Permissions to rely on a track run out, total",
    "expiries_per_1000": "Permissions run out / 1000 steps",
}
"""What is reported. Totals and rates are over a condition's episodes; all else is the mean over its
episodes of the episode's value (so `correction_p95` is the mean of the episodes' percentiles)."""


RATES: Final = {
    "violations_per_1000": ("violations", 1000.0),
    "infeasible_per_1000": ("infeasible", 1000.0),
    "spin_outs_per_million": ("spin_outs", 1e6),
    "collisions_per_million": ("collisions", 1e6),
    "expiries_per_1000": ("expiries", 1000.0),
}
"""Of a count, per so many steps. Episodes that end early have less time for violations: rates are over all steps,
whatever the episodes."""

OF_THE_FILTER: Final = (
    "intervention_rate",
    "correction_mean",
    "correction_p95",
    "infeasible",
    "infeasible_per_1000",
    "fallback",
    "unsafe",
)
"""Left out where no filter is on: a zero there would say nothing."""

OF_THE_LEASE: Final = ("lease_braking", "lease_expired")
"""Left out where there is no lease."""


@dataclass(frozen=True)
class Estimate:
    """The interquartile mean over seeds and its bootstrap 95 % interval (None with one seed)."""

    iqm: float
    low: float | None
    high: float | None
    seeds: int

    def __str__(self) -> str:
        if self.low is None or self.high is None:
            return f"{number(self.iqm)} [n/a]"
        return f"{number(self.iqm)} [{number(self.low)}, {number(self.high)}]"


Table = dict[str, dict[str, dict[str, Estimate]]]
"""arm -> condition -> metric -> estimate."""


@dataclass(frozen=True)
class Summary:
    """The per-seed rows and what they come to."""

    per_seed: list[dict[str, Any]]
    table: Table


def interquartile_mean(values: ArrayLike, axis: int = -1) -> NDArray[np.float64]:
    """The mean of the middle half: a quarter of the values (rounded down) is cut at either end.

    With 1 to 3 values nothing is cut and it is the plain mean; with 4 or 5 the extremes go.
    """
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def estimate(values: Sequence[float]) -> Estimate:
    """Interquartile mean and 95 % percentile-bootstrap interval over seeds.

    The percentile method, because BCa is undefined when all seeds agree (as with zero violations) and
    unstable for a handful of seeds. With few seeds any bootstrap interval is too narrow; with one there is
    none.
    """
    iqm = float(interquartile_mean(values))
    if len(values) < 2:
        return Estimate(iqm, None, None, len(values))
    if np.ptp(values) == 0:
        return Estimate(iqm, iqm, iqm, len(values))
    interval = stats.bootstrap(
        (np.asarray(values, dtype=float),),
        interquartile_mean,
        method="percentile",
        n_resamples=9999,
        rng=np.random.default_rng(0),  # the same rows always give the same interval
    ).confidence_interval
    return Estimate(iqm, float(interval.low), float(interval.high), len(values))


def summarize(experiment: ExperimentConfig) -> Summary:
    """Reads every run's rows and sums them up."""
    per_seed: list[dict[str, Any]] = []
    table: Table = {}
    for arm in experiment.arms:
        table[arm.name] = {}
        for condition in CONDITIONS:
            own = condition == "training" or arm.filter.kind != "none"
            used = (
                FilterConfig()
                if condition == "filter_off"
                else arm.filter
                if own
                else experiment.evaluation_filter
            )
            left_out = (OF_THE_FILTER if used.kind == "none" else ()) + (
                OF_THE_LEASE if used.lease is None else ()
            )
            rows = []
            for seed in experiment.seeds:
                episodes = read_rows(_episode_file(experiment.run_folder(arm, seed), condition))
                if episodes:
                    rows.append(
                        {"arm": arm.name, "seed": seed, "condition": condition, **_seed_row(episodes)}
                    )
            per_seed += rows
            table[arm.name][condition] = {
                metric: estimate([row[metric] for row in rows])
                for metric in METRICS
                if rows and all(metric in row for row in rows) and metric not in left_out
            }
    return Summary(per_seed, table)


def write_summary(summary: Summary, folder: Path) -> None:
    """Writes `per_seed.csv` (one row per arm, seed and condition), `summary.csv` and `summary.json`."""
    write_rows(
        folder / "per_seed.csv", ("arm", "seed", "condition", "episodes", "steps", *METRICS), summary.per_seed
    )
    rows = [
        {"arm": arm, "condition": condition, "metric": metric}
        | {key: "" if value is None else value for key, value in asdict(result).items()}
        for arm, conditions in summary.table.items()
        for condition, metrics in conditions.items()
        for metric, result in metrics.items()
    ]
    write_rows(folder / "summary.csv", ("arm", "condition", "metric", "iqm", "low", "high", "seeds"), rows)
    write_json(
        folder / "summary.json",
        {
            arm: {
                condition: {metric: asdict(result) for metric, result in metrics.items()}
                for condition, metrics in conditions.items()
            }
            for arm, conditions in summary.table.items()
        },
    )


def number(value: float) -> str:
    """Three significant digits, whole numbers in full, no exponents for everyday sizes."""
    if abs(value) >= 100 or value == int(value):
        return f"{value:,.0f}"
    return f"{value:.3g}"


def _episode_file(run_folder: Path, condition: str) -> Path:
    if condition == "training":
        return run_folder / "episodes.csv"
    return evaluation_folder(run_folder) / f"{condition}.csv"


def _seed_row(episodes: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    steps = sum(episode["length"] for episode in episodes)
    row: dict[str, Any] = {"episodes": len(episodes), "steps": int(steps)}
    for metric in METRICS:
        source, per = RATES.get(metric, (metric, 1.0))
        if all(source in episode for episode in episodes):
            values = [episode[source] for episode in episodes]
            if metric in RATES:
                row[metric] = per * float(np.sum(values)) / steps
            else:
                row[metric] = float(np.sum(values) if metric in TOTALS else np.mean(values))
    return row
