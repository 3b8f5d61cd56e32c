"""Experiments that were never run: folders as runs leave them, filled with chosen numbers."""

import json

import numpy as np

from safe_wrappers.train.evaluation.evaluate import EVALUATION_COLUMNS, evaluation_folder
from safe_wrappers.train.evaluation.step_log import StepLog, save_steps
from safe_wrappers.train.files import write_rows
from safe_wrappers.train.run.training import EPISODE_COLUMNS

SILENT = dict.fromkeys(("cost", "cost_substep", "violations"), "")
"""What a task reports that judges nothing."""


def episode(**values):
    return dict.fromkeys(EPISODE_COLUMNS[2:], 0.0) | {"length": 100} | values


def write_training(experiment, arm, seed, rows):
    folder = experiment.run_folder(experiment.arms[arm], seed)
    write_rows(folder / "episodes.csv", EPISODE_COLUMNS, [{"env": 0, **row} for row in rows])
    (folder / "finished.json").write_text(
        json.dumps({"timesteps": experiment.arms[arm].total_steps, "filter_time_us": 50.0 if arm else None})
    )


def write_evaluation(experiment, arm, seed, condition, rows, steps=None):
    folder = evaluation_folder(experiment.run_folder(experiment.arms[arm], seed))
    rows = [{"episode_seed": 100 + at, **row} for at, row in enumerate(rows)]
    write_rows(folder / f"{condition}.csv", EVALUATION_COLUMNS, rows)
    if steps is not None:
        save_steps(folder / f"{condition}_steps.npz", steps)


def steps(count=200, **values):
    """A log of `count` steps of two episodes in which nothing happened, but for `values`."""
    none = np.zeros(count, dtype=bool)
    columns = {
        "episode_seed": 100 + 2 * np.arange(count) // count,
        "step": (np.arange(count) % (count // 2)).astype(np.int32),
        **dict.fromkeys(("intervened", "violated"), none),
        "correction": np.zeros(count, np.float32),
        "proposed": np.zeros((count, 2), np.float32),
        "refused": np.zeros((count, 1), dtype=bool),
        "coordinates": np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32),
        "constraint_names": np.array(["Clearance"]),
        "coordinate_names": np.array(["x (m)", "y (m)", "speed (m/s)"]),
        "left_out": 0,
    }
    return StepLog(**(columns | values))


def fill(experiment, off, on, log_off=None, log_on=None):
    """A whole comparison: arm 0 without and arm 1 with the filter.

    Args:
        experiment: Two arms.
        off: An episode's values without the filter, in training and evaluation.
        on: With it.
        log_off: Steps of the evaluation without it.
        log_on: With it.
    """
    for seed in experiment.seeds:
        for arm, values in ((0, off), (1, on)):
            rows = [episode(timesteps=100 * t, **values) for t in range(1, 11)]
            write_training(experiment, arm, seed, rows)
            write_evaluation(experiment, arm, seed, "filter_off", [episode(**off)] * 2, log_off)
            write_evaluation(experiment, arm, seed, "filter_on", [episode(**on)] * 2, log_on)
