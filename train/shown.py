"""What of an experiment is shown first: which two arms are compared, and which episode is looked at."""

from __future__ import annotations

from dataclasses import dataclass

from .config import ArmConfig, ExperimentConfig
from .evaluate import evaluation_folder
from .tables import read_rows


@dataclass(frozen=True)
class Pair:
    """A comparison: one arm and condition without the filter, one with it.

    Attributes:
        bare: Without the filter; the filtered arm itself where the experiment has no arm without one.
        filtered: With the filter.
    """

    bare: ArmConfig
    filtered: ArmConfig

    @property
    def same_policy(self) -> bool:
        """The two differ only in the filter at evaluation."""
        return self.bare == self.filtered


@dataclass(frozen=True)
class ShownEpisode:
    """One evaluation episode, looked at in every arm and condition."""

    seed: int
    """The training seed of the policies."""
    episode_seed: int
    reason: str
    """How it was chosen, for the page."""


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
    """The evaluation episode with most violations without the filter; None before any evaluation.

    Where there is no violation, the one in which the filter changed most. Not an arbitrary one, which may show
    nothing at all, and not the best one: the page says which it is.
    """
    pair = next(iter(compared_pairs(experiment)), None)
    bare = pair.bare if pair is not None else experiment.arms[0]
    seed = experiment.seeds[0]
    rows = _rows(experiment, bare, seed, "filter_off")
    if not rows:
        return None
    worst = max(rows, key=lambda row: row["violations"])  # the first of equals
    of = f"of the {len(rows)} evaluation episodes"
    chosen = f"{of} the one in which {bare.name} had most violations with the filter off"
    if not worst["violations"]:
        chosen = f"the first {of}"
        acting = _rows(experiment, pair.filtered, seed, "filter_on") if pair is not None else []
        if pair is not None and any(row["intervention_rate"] for row in acting):
            worst = max(acting, key=lambda row: row["intervention_rate"])
            chosen = f"{of} the one in which the filter changed most of what {pair.filtered.name} proposed"
        else:
            worst = rows[0]
    episode_seed = int(worst["episode_seed"])
    return ShownEpisode(
        seed, episode_seed, f"Episode seed {episode_seed}, policies of training seed {seed}: {chosen}."
    )


def _rows(experiment: ExperimentConfig, arm: ArmConfig, seed: int, condition: str) -> list[dict[str, float]]:
    return read_rows(evaluation_folder(experiment.run_folder(arm, seed)) / f"{condition}.csv")
