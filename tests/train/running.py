"""Runs in this process: trained, killed, resumed, evaluated; and some that never were, of chosen numbers."""

import json

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from safe_wrappers.train.evaluation.evaluate import EVALUATION_COLUMNS, evaluate_run
from safe_wrappers.train.evaluation.step_log import StepLog, save_steps
from safe_wrappers.train.files import read_rows, write_rows
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run.checkpoint import latest_checkpoint, resume
from safe_wrappers.train.run.stack import make_vec_env
from safe_wrappers.train.run.training import EPISODE_COLUMNS

SILENT = Progress(lambda steps: None, pytest.fail)
"""Of runs that have nothing to say."""


class Reports:
    """What a run tells."""

    def __init__(self):
        self.steps, self.lines = [], []
        self.progress = Progress(self.steps.append, self.lines.append)


def trained(experiment, arm=1, seed=0, progress=SILENT):
    """Trains a run of the experiment, or goes on with it; returns its folder."""
    folder = experiment.run_folder(experiment.arms[arm], seed)
    train_run(experiment.arms[arm], seed, folder, progress)
    return folder


def evaluated(experiment, arm=1, seed=0, progress=SILENT):
    """Evaluates a trained run; returns the evaluation's folder."""
    config = experiment.arms[arm]
    folder = experiment.run_folder(config, seed)
    evaluate_run(config, seed, folder, experiment.evaluation, experiment.evaluation_filter, progress)
    return folder / "evaluation"


def killed_after(experiment, checkpoints, arm=1):
    """Trains until some checkpoints are there and episodes beyond the last one, as a kill would leave it."""

    class Killed(BaseException):
        pass

    folder, seen = experiment.run_folder(experiment.arms[arm], 0), set()

    def stopping():
        found = latest_checkpoint(folder / "checkpoints")
        seen.update([found.timesteps] if found else [])
        if len(seen) == checkpoints and episodes(folder)[-1]["timesteps"] > found.timesteps:
            raise Killed
        return False

    with pytest.raises(Killed):
        trained(experiment, arm, progress=Progress(SILENT.steps, SILENT.say, stopping))
    return folder


def resumed(arm, folder):
    """The model of the newest checkpoint, as a run goes on with it."""
    checkpoint = latest_checkpoint(folder / "checkpoints")
    return resume(checkpoint.folder, arm.algorithm, make_vec_env(arm), "cpu", 100)


def finish(folder):
    """What a finished run notes."""
    return json.loads((folder / "finished.json").read_text())


def episodes(folder):
    """The rows of a run's training, which are in the order of its steps whatever has happened to it."""
    rows = read_rows(folder / "episodes.csv")
    steps = [row["timesteps"] for row in rows]
    assert steps == sorted(steps)
    return rows


def scalars(folder):
    """Tag -> (step, value) pairs, of what a run sent to TensorBoard."""
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {
        tag: [(each.step, each.value) for each in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }


# Experiments that were never run: folders as runs leave them, filled with chosen numbers ----------------------------

JUDGES_NOTHING = dict.fromkeys(("cost", "cost_substep", "violations"), "")
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
    folder = experiment.run_folder(experiment.arms[arm], seed) / "evaluation"
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
