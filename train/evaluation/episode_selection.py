"""What of an experiment is shown first: which two arms are compared, and which episodes are looked at."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from ..config import ArmConfig, ExperimentConfig
from ..files import read_rows
from .evaluate import evaluation_folder


class Pair(NamedTuple):
    """A comparison: an arm without the filter (the filtered one itself where there is no other), and one with it."""

    bare: ArmConfig
    filtered: ArmConfig


class ShownEpisode(NamedTuple):
    """The evaluation episode that is looked at in every arm and condition, and the worst one beside it on film.

    Attributes:
        seed: The training seed of the policies.
        episode_seed: Of the typical episode.
        worst_seed: Of the one with the lowest return.
        reason: How they were chosen, for the page.
    """

    seed: int
    episode_seed: int
    worst_seed: int
    reason: str

    @property
    def filmed(self) -> dict[str, int]:
        """What is on film, as `filmed_seeds` returns it."""
        return filmed_seeds(self.episode_seed, self.worst_seed)


def compared_pairs(experiment: ExperimentConfig) -> list[Pair]:
    """What the headline compares.

    - The first arm with a filter, and the first one without a filter on the same env (or, where there is none,
      the filtered arm with its filter off);
    - where no arm has a filter but the evaluation does: every arm, with it off and on;
    - nothing where there is no filter at all.
    """
    filtered = next((arm for arm in experiment.arms if arm.filter.kind != "none"), None)
    if filtered is not None:
        bare = (arm for arm in experiment.arms if arm.filter.kind == "none" and arm.env == filtered.env)
        return [Pair(next(bare, filtered), filtered)]
    if experiment.evaluation_filter.kind != "none":
        return [Pair(arm, arm) for arm in experiment.arms]
    return []


def shown_episode(experiment: ExperimentConfig) -> ShownEpisode | None:
    """The evaluation episode with the median return of the headline's policy; None before any evaluation.

    The policy is that of the first filtered arm with the filter on, or of the first arm where nothing is filtered.
    """
    pair = next(iter(compared_pairs(experiment)), None)
    arm, condition = (experiment.arms[0], "filter_off") if pair is None else (pair.filtered, "filter_on")
    seed = experiment.seeds[0]
    rows = read_rows(evaluation_folder(experiment.run_folder(arm, seed)) / f"{condition}.csv")
    if not rows:
        return None
    typical, worst = typical_and_worst({int(row["episode_seed"]): row["return"] for row in rows})
    words = f"“{arm.name}” with the {condition.replace('_', ' ')}"
    reason = (
        f"Episode seed {typical}, policies of training seed {seed}: of the {len(rows)} evaluation episodes the one"
        f" with the median return of {words}. The worst, {worst}, is the one with its lowest return."
    )
    return ShownEpisode(seed, typical, worst, reason)


def typical_and_worst(returns: Mapping[int, float]) -> tuple[int, int]:
    """The episode seeds with the median return (of an even number the lower one) and with the lowest."""
    ordered = sorted(returns, key=lambda seed: (returns[seed], seed))
    return ordered[(len(ordered) - 1) // 2], ordered[0]


def filmed_seeds(typical: int, worst: int) -> dict[str, int]:
    """Episode seeds by title; of a single episode there is one film."""
    return {"typical": typical} | ({"worst": worst} if worst != typical else {})
