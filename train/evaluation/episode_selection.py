"""What of an experiment is shown first: which two arms are compared, and which episode is looked at."""

from __future__ import annotations

from dataclasses import dataclass

from ..config import ArmConfig, ExperimentConfig
from ..tables import read_rows
from .evaluate import evaluation_folder


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
    pairs = compared_pairs(experiment)
    seed = experiment.seeds[0]
    bare = [pair.bare for pair in pairs] or list(experiment.arms)
    violations = _totals(experiment, bare, seed, "filter_off", "violations")
    if not violations:
        return None
    acting = [pair.filtered for pair in pairs]
    changes = _totals(experiment, acting, seed, "filter_on", "intervention_rate")
    of = f"of the {len(violations)} evaluation episodes"
    if any(violations.values()):
        episode_seed = max(violations, key=violations.__getitem__)  # the first of equals
        chosen = f"{of} the one with most violations of {_named(bare)} with the filter off"
    elif any(changes.values()):
        episode_seed = max(changes, key=changes.__getitem__)
        chosen = f"{of} the one in which the filter changed most steps of {_named(acting)}"
    else:
        episode_seed = next(iter(violations))
        chosen = f"the first {of}"
    return ShownEpisode(
        seed, episode_seed, f"Episode seed {episode_seed}, policies of training seed {seed}: {chosen}."
    )


def _totals(
    experiment: ExperimentConfig, arms: list[ArmConfig], seed: int, condition: str, column: str
) -> dict[int, float]:
    """A column's sum over arms, by episode seed; what was not judged or reported moves no choice."""
    totals: dict[int, float] = {}
    for arm in arms:
        path = evaluation_folder(experiment.run_folder(arm, seed)) / f"{condition}.csv"
        for row in read_rows(path):
            episode_seed = int(row["episode_seed"])
            totals[episode_seed] = totals.get(episode_seed, 0.0) + row.get(column, 0.0)
    return totals


def _named(arms: list[ArmConfig]) -> str:
    names = [f"“{arm.name}”" for arm in arms]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]} together"
