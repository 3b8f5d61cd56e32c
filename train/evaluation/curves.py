"""Learning curves: each metric over training steps, interquartile mean and interval (of two, range) over seeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from safe_wrappers.checks import Array

from ..config import ArmConfig, ExperimentConfig
from ..files import read_rows
from .summary import SEEDS_FOR_AN_INTERVAL, interquartile_mean

_MOST_BINS = 40


@dataclass(frozen=True)
class Curve:
    """One arm's metric over B bins of steps; of two seeds their range, of one none."""

    steps: Array
    """(B,)"""
    iqm: Array
    """(B,): over seeds."""
    low: Array | None
    """(B,)"""
    high: Array | None
    """(B,)"""
    seeds: Array
    """(seeds, B): each seed's own."""
    names: tuple[int, ...]
    """The seeds, in the order of the rows."""


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
        means = np.array([_bin_ratios(edges, run[:, 0], run[:, 1], np.ones(len(run))) for run in runs])
        if np.isfinite(means).all():
            break
    low, high = _interval(means)
    return Curve(
        (edges[:-1] + edges[1:]) / 2,
        interquartile_mean(means, axis=0),
        low,
        high,
        means,
        tuple(experiment.seeds),
    )


def event_rate(experiment: ExperimentConfig, arm: ArmConfig, event: str) -> tuple[Array, Array, int] | None:
    """How often something happened while training, all seeds together.

    Args:
        experiment: Where the runs lie.
        arm: Which arm.
        event: A column of `episodes.csv` that counts steps, such as `infeasible`.

    Returns:
        Edges of bins of training steps, shape (B + 1,), events per 1000 steps in each, shape (B,), NaN where
        no episode ended, and their number in all; None without any episode that reports it.
    """
    rows = np.array(
        [
            (row["timesteps"], row[event], row["length"])
            for seed in experiment.seeds
            for row in read_rows(experiment.run_folder(arm, seed) / "episodes.csv")
            if event in row
        ]
    )
    if not rows.size:
        return None
    ends, events, lengths = rows.T
    edges = np.linspace(0, ends.max(), _MOST_BINS + 1)
    return edges, _bin_ratios(edges, ends, 1000 * events, lengths), int(events.sum())


def _bin_ratios(edges: Array, at: Array, over: Array, under: Array) -> Array:
    """Sum over sum in each bin; NaN in an empty one."""
    bins = np.searchsorted(edges[1:-1], at)
    sums, counts = (np.bincount(bins, weights=w, minlength=len(edges) - 1) for w in (over, under))
    ratios = np.full(len(counts), np.nan)
    np.divide(sums, counts, out=ratios, where=counts > 0)
    return ratios


def _interval(means: Array) -> tuple[Array | None, Array | None]:
    if len(means) < 2:
        return None, None
    if len(means) < SEEDS_FOR_AN_INTERVAL:
        return means.min(axis=0), means.max(axis=0)
    interval = stats.bootstrap(
        (means,),
        interquartile_mean,
        axis=0,
        method="percentile",
        n_resamples=2000,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return interval.low, interval.high
