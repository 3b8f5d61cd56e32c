"""The registry of the reported numbers: label, what each counts, its unit, and when it is absent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from safe_wrappers.info import COST, EPISODE


@dataclass(frozen=True)
class Metric:
    """One number of the tables.

    Attributes:
        label: Its heading.
        counts: What it counts, in whole sentences.
        unit: "" for a plain count.
        absent: When there is none, where no info key that it is made from says so.
    """

    label: str
    counts: str
    unit: str = ""
    absent: str = ""


_TOTAL: Final = "Over all episodes of the condition."
_MEAN: Final = "Mean over the condition's episodes."
_OF_CONDITION: Final = {
    "return": Metric("Return / episode", f"The task's own reward summed over an episode. {_MEAN}", "reward"),
    "length": Metric("Steps / episode", f"Control steps of an episode. {_MEAN}", "steps"),
    "cost": Metric(
        "Cost / episode",
        f"The task's cost at the ends of control steps, summed over an episode. {_MEAN}",
        "cost",
    ),
    "cost_substep": Metric(
        "Cost in substeps / episode",
        f"Steps of an episode with a cost at any physics substep, also between their ends. {_MEAN}",
        "steps",
    ),
    "violations": Metric(
        "Steps in violation, total",
        "Control steps in which the task itself reports a cost, at their end or at any physics substep. The"
        f" filter's opinion does not count. {_TOTAL}",
        "steps",
    ),
    "violations_per_1000": Metric(
        "Steps in violation / 1000", "Steps in violation per 1000 control steps.", "per 1000 steps"
    ),
    "intervention_rate": Metric(
        "Share of steps changed",
        f"Steps whose executed action is not the proposed one, per steps of an episode. {_MEAN}",
        "0 to 1",
    ),
    "correction_mean": Metric(
        "Correction, mean",
        "L2 norm of executed minus proposed action, over all steps of an episode, also those left alone."
        f" {_MEAN}",
        "action units",
    ),
    "correction_p95": Metric(
        "Correction, 95th pct.",
        f"The size of correction that 95 % of an episode's steps stay below. {_MEAN}",
        "action units",
    ),
    "infeasible": Metric(
        "Infeasible steps, total",
        f"Steps at which no admissible action satisfied every constraint of the filter. {_TOTAL}",
        "steps",
    ),
    "infeasible_per_1000": Metric(
        "Infeasible steps / 1000", "Infeasible steps per 1000 control steps.", "per 1000 steps"
    ),
    "fallback": Metric(
        "Fallback steps, total",
        f"Steps at which the filter's last resort chose the action. {_TOTAL}",
        "steps",
    ),
    "unsafe": Metric(
        "Steps begun with h < 0, total",
        f"Steps that began outside of the filter's own safe set. {_TOTAL}",
        "steps",
    ),
    "stuck": Metric(
        "Stuck steps, total",
        f"Steps at which the filter had changed most of the last actions, and the reward stood still. {_TOTAL}",
        "steps",
    ),
    "lease_braking": Metric(
        "Steps braked by the lease, total",
        f"Steps at which the fallback acted because the lease had run out. {_TOTAL}",
        "steps",
    ),
    "lease_expired": Metric(
        "Leases run out, total", f"Leases that ran out before the next action came. {_TOTAL}", "leases"
    ),
    "goals_reached": Metric("Goals / episode", f"Goals reached in an episode. {_MEAN}", "goals"),
    "spin_outs": Metric(
        "Steps in spin-out, total",
        f"Steps in which a loaded wheel spun or locked (slip above 0.5). {_TOTAL}",
        "steps",
    ),
    "spin_outs_per_million": Metric(
        "Steps in spin-out / million", "Steps in spin-out per million control steps.", "per million steps"
    ),
    "collisions": Metric("Collisions, total", f"Collisions begun. {_TOTAL}", "collisions"),
    "collisions_per_million": Metric(
        "Collisions / million steps", "Collisions begun per million control steps.", "per million steps"
    ),
    "seen": Metric(
        "Share of time that a track is seen",
        f"Share of steps and tracks with a measurement at the end of the step. {_MEAN}",
        "0 to 1",
    ),
    "expiries": Metric(
        "Permissions to rely on a track run out, total",
        f"Times that a track's uncertainty grew beyond its tolerance. {_TOTAL}",
    ),
    "expiries_per_1000": Metric(
        "Permissions run out / 1000 steps", "Permissions run out per 1000 control steps.", "per 1000 steps"
    ),
}
_OF_A_RUN: Final = {
    "arm": Metric("Arm", "The arm's name in the config."),
    "seed": Metric("Seed", "The seed of the training run."),
    "condition": Metric("Condition", "Training, or evaluation with the filter off or on."),
    "episodes": Metric("Episodes", "Episodes that were finished."),
    "steps": Metric("Steps", "Control steps of the finished episodes; one that was cut off is not in."),
    "elapsed_s": Metric(
        "Training time",
        "Wall clock of the training of one run, all its parts if it was stopped in between, on the machine that"
        " ran it and beside what else ran there.",
        "h:mm:ss",
        "The run is not finished.",
    ),
    "steps_per_s": Metric(
        "Steps/s",
        "The policy's steps per second of training time; with an action repeat each is several control steps.",
        absent="The run is not finished.",
    ),
    "filter_time_us": Metric(
        "Filter call in µs",
        "Mean time of a filter call in training, on the machine that ran it.",
        "microseconds",
        "No filter is on, or the run is not finished.",
    ),
}
REGISTRY: Final[dict[str, Metric]] = _OF_A_RUN | _OF_CONDITION
"""Column or metric -> what it is."""
METRICS: Final = {name: metric.label for name, metric in _OF_CONDITION.items()}
"""What is reported of a condition. Totals and rates are over its episodes; all else is the mean over its episodes of
the episode's value (so `correction_p95` is the mean of the episodes' percentiles)."""
TOTALS: Final = tuple(figure.name for figure in EPISODE if figure.how in ("count", "onsets"))
RATES: Final = {
    "violations_per_1000": ("violations", 1000.0),
    "infeasible_per_1000": ("infeasible", 1000.0),
    "spin_outs_per_million": ("spin_outs", 1e6),
    "collisions_per_million": ("collisions", 1e6),
    "expiries_per_1000": ("expiries", 1000.0),
}
"""Of a count, per so many steps. Episodes that end early have less time for violations: rates are over all steps,
whatever the episodes."""


def _made_from(*names: str) -> tuple[str, ...]:
    """The metrics that are made from info keys whose names begin with one of these."""
    return tuple(metric for metric in METRICS if (of := sources(metric)) and of[0].startswith(names))


def sources(metric: str) -> tuple[str, ...]:
    """The info keys that a metric is made from; none for what needs no key."""
    figures = {figure.name: figure.of for figure in EPISODE}
    return figures.get(RATES.get(metric, (metric,))[0], ())


OF_THE_FILTER: Final = _made_from("cbf/")
"""Left out where no filter is on: a zero there would say nothing."""
OF_THE_LEASE: Final = _made_from("lease/")
"""Left out where there is no lease."""
OF_THE_JUDGE: Final = _made_from(COST)
"""Left out where nobody judged: a zero there would be a lie."""
NOT_JUDGED: Final = "not judged"


def absent(metric: str) -> str:
    """When there is no such number, as a sentence; "" for one that is always there."""
    if not sources(metric):
        return REGISTRY[metric].absent
    keys = " or ".join(f"`{key}`" for key in sources(metric))
    if metric in OF_THE_JUDGE:
        return f"The task reports no {keys}: it is “{NOT_JUDGED}”."
    why = {OF_THE_FILTER: "No filter is on", OF_THE_LEASE: "There is no lease"}
    for group, reason in why.items():
        if metric in group:
            return f"{reason}: nothing reports {keys}."
    return f"Nothing reports {keys}."
