"""Learning curves: each metric over training steps, interquartile mean and interval over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .config import ArmConfig, ExperimentConfig
from .summary import interquartile_mean
from .tables import read_rows

_MOST_BINS = 40


@dataclass(frozen=True)
class Curve:
    """One arm's metric over steps; no interval with one seed."""

    steps: NDArray[np.float64]
    iqm: NDArray[np.float64]
    low: NDArray[np.float64] | None
    high: NDArray[np.float64] | None


def learning_curve(experiment: ExperimentConfig, arm: ArmConfig, metric: str) -> Curve | None:
    """Means over equal bins of steps, as many as leave no seed without an episode in one (at most 40).

    Args:
        experiment: Where the runs lie.
        arm: Which arm.
        metric: A column of the runs' `episodes.csv`.

    Returns:
        The curve, or None when some seed has no episode with that metric.
    """
    runs = []
    for seed in experiment.seeds:
        rows = read_rows(experiment.run_folder(arm, seed) / "episodes.csv")
        runs.append(
            np.array([(row["timesteps"], row[metric]) for row in rows if metric in row]).reshape(-1, 2)
        )
    if not all(len(run) for run in runs):
        return None
    end = max(run[-1, 0] for run in runs)
    for bins in range(_MOST_BINS, 0, -1):
        edges = np.linspace(0, end, bins + 1)
        means = np.array([_bin_means(run, edges) for run in runs])
        if np.isfinite(means).all():
            break
    return Curve((edges[:-1] + edges[1:]) / 2, interquartile_mean(means, axis=0), *_interval(means))


def _bin_means(run: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    at = np.searchsorted(edges[1:-1], run[:, 0])
    counts = np.bincount(at, minlength=len(edges) - 1)
    sums = np.bincount(at, weights=run[:, 1], minlength=len(edges) - 1)
    means = np.full(len(counts), np.nan)
    np.divide(sums, counts, out=means, where=counts > 0)
    return means


def _interval(means: NDArray[np.float64]) -> Sequence[NDArray[np.float64] | None]:
    if len(means) < 2:
        return None, None
    interval = stats.bootstrap(
        (means,),
        interquartile_mean,
        axis=0,
        method="percentile",
        n_resamples=2000,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return interval.low, interval.high
