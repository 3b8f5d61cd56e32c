"""Who judges an experiment's tasks: without a cost nothing can be counted as a violation."""

from __future__ import annotations

import numpy as np

from ..config import ArmConfig, ExperimentConfig
from .evaluate import evaluation_folder


def judged_by(experiment: ExperimentConfig, judged: bool) -> str:
    """Who judges, in a sentence for tables and pages; empty where it is the task itself.

    Args:
        experiment: The experiment.
        judged: Whether a cost was reported at all.
    """
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


def evaluated_without_cost(experiment: ExperimentConfig, arm: ArmConfig) -> bool:
    """True if steps of the arm's evaluation are recorded and none of them has a cost.

    Tables of earlier versions hold zeros for a task that reports no cost; the recorded steps tell.
    """
    judged = []
    for seed in experiment.seeds:
        path = evaluation_folder(experiment.run_folder(arm, seed)) / "filter_off_steps.npz"
        if path.exists():
            with np.load(path) as arrays:
                judged.append(bool(np.isfinite(arrays["cost"]).any()))
    return bool(judged) and not any(judged)
