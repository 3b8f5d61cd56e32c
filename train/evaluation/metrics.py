"""The registry of the reported numbers: label, what each counts, and its unit."""

from __future__ import annotations

from typing import Final, NamedTuple

from safe_wrappers.info import COST, EPISODE


class Metric(NamedTuple):
    """One number of the tables: its heading, what it counts, and its unit ("" for a plain count)."""

    label: str
    counts: str
    unit: str = ""


REGISTRY: Final[dict[str, Metric]] = {
    "return": Metric("Return / episode", "The task's own reward, summed over an episode", "reward"),
    "length": Metric("Steps / episode", "Control steps of an episode", "steps"),
    "cost": Metric("Cost / episode", "The task's cost at the ends of control steps, summed", "cost"),
    "cost_substep": Metric("Cost in substeps / episode", "Steps with a cost at any physics substep", "steps"),
    "violations": Metric(
        "Steps in violation, total",
        "Control steps in which the task itself reports a cost, at their end or at any physics substep; the"
        " filter's opinion does not count",
        "steps",
    ),
    "violations_per_1000": Metric("Steps in violation / 1000", "Steps in violation", "per 1000 steps"),
    "intervention_rate": Metric(
        "Share of steps changed", "Steps whose executed action is not the proposed one"
    ),
    "correction_mean": Metric(
        "Correction, mean", "L2 norm of executed minus proposed action, over all steps", "action units"
    ),
    "correction_p95": Metric(
        "Correction, 95th pct.", "The correction that 95 % of an episode's steps stay below", "action units"
    ),
    "infeasible": Metric(
        "Infeasible steps, total",
        "Steps at which no action that was tried satisfied every constraint of the filter",
        "steps",
    ),
    "infeasible_per_1000": Metric("Infeasible steps / 1000", "Infeasible steps", "per 1000 steps"),
    "fallback": Metric("Fallback steps, total", "Steps at which the filter's last resort acted", "steps"),
    "unsafe": Metric(
        "Steps begun with h < 0, total", "Steps begun outside of the filter's safe set", "steps"
    ),
    "stuck": Metric(
        "Stuck steps, total",
        "Steps with most of the last actions changed, while the reward stood still",
        "steps",
    ),
    "lease_braking": Metric(
        "Steps braked by the lease, total", "Fallback steps of an expired lease", "steps"
    ),
    "goals_reached": Metric("Goals / episode", "Goals reached in an episode", "goals"),
    "spin_outs": Metric("Steps in spin-out, total", "Steps with a loaded wheel's slip above 0.5", "steps"),
    "spin_outs_per_million": Metric("Steps in spin-out / million", "Steps in spin-out", "per million steps"),
    "collisions": Metric("Collisions, total", "Collisions begun", "collisions"),
    "collisions_per_million": Metric("Collisions / million steps", "Collisions begun", "per million steps"),
    "seen": Metric("Share of time that a track is seen", "Steps and tracks with a measurement at the end"),
}
METRICS: Final = {name: metric.label for name, metric in REGISTRY.items()}
"""What is reported of a condition. Totals and rates are over its episodes; all else is the mean over its episodes of
the episode's value (so `correction_p95` is the mean of the episodes' percentiles)."""
TOTALS: Final = tuple(figure.name for figure in EPISODE if figure.how == "count")
RATES: Final = {
    "violations_per_1000": ("violations", 1000.0),
    "infeasible_per_1000": ("infeasible", 1000.0),
    "spin_outs_per_million": ("spin_outs", 1e6),
    "collisions_per_million": ("collisions", 1e6),
}
"""Of a count, per so many steps. Episodes that end early have less time for violations: rates are over all steps,
whatever the episodes."""


def _made_from(prefix: str) -> tuple[str, ...]:
    """The metrics that are made from info keys that begin so."""
    of = {figure.name: figure.of[0] for figure in EPISODE}
    return tuple(m for m in METRICS if of.get(RATES.get(m, (m,))[0], "").startswith(prefix))


OF_THE_FILTER: Final = _made_from("cbf/")
"""Left out where no filter is on: a zero there would say nothing."""
OF_THE_LEASE: Final = _made_from("lease/")
"""Left out where there is no lease."""
OF_THE_JUDGE: Final = _made_from(COST)
"""Left out where nobody judged: a zero there would be a lie."""
NOT_JUDGED: Final = "not judged"
