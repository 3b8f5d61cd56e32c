"""Runs in this process: trained, killed, resumed, evaluated."""

import json

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluation_folder
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run.checkpoint import latest_checkpoint, resume
from safe_wrappers.train.run.stack import make_vec_env
from safe_wrappers.train.run.training import CheckpointCallback

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
    return evaluation_folder(folder)


def killed_after(experiment, checkpoints, monkeypatch, arm=1):
    """Trains until some checkpoints are there, and 64 steps more, as a kill would leave it."""

    class Killed(BaseException):
        pass

    saved, step, start = [], CheckpointCallback._on_step, CheckpointCallback._on_rollout_start

    def stepping(self):
        if len(saved) == checkpoints and self.num_timesteps - saved[-1] >= 64:
            raise Killed
        return step(self)

    def saving(self):
        before = self._last
        start(self)
        if self._last != before:
            saved.append(self._last)

    with monkeypatch.context() as patch:
        patch.setattr(CheckpointCallback, "_on_step", stepping)
        patch.setattr(CheckpointCallback, "_on_rollout_start", saving)
        with pytest.raises(Killed):
            trained(experiment, arm)
    return experiment.run_folder(experiment.arms[arm], 0)


def resumed(arm, folder):
    """The model of the newest checkpoint, as a run goes on with it."""
    checkpoint = latest_checkpoint(folder / "checkpoints")
    return resume(checkpoint.folder, arm.algorithm, make_vec_env(arm), "cpu", 100)


def finish(folder):
    """What a finished run notes."""
    return json.loads((folder / "finished.json").read_text())


def episodes(folder):
    """The rows of a run's training."""
    return read_rows(folder / "episodes.csv")


def scalars(folder):
    """Tag -> (step, value) pairs, of what a run sent to TensorBoard."""
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {
        tag: [(each.step, each.value) for each in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }
