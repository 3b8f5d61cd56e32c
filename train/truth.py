"""Whether a task judges itself: without a cost of its own nothing can be counted as a violation."""

from __future__ import annotations

import numpy as np

from .config import ExperimentConfig
from .evaluate import evaluation_folder


def reports_cost(experiment: ExperimentConfig) -> bool:
    """False only if every recorded evaluation step of the experiment lacks a cost."""
    seen = []
    for arm in experiment.arms:
        for seed in experiment.seeds:
            path = evaluation_folder(experiment.run_folder(arm, seed)) / "filter_off_steps.npz"
            if path.exists():
                with np.load(path) as arrays:
                    seen.append(bool(np.isfinite(arrays["cost"]).any()))
    return any(seen) or not seen
