"""A run that is asked to stop: by SIGTERM, in the midst of a rollout."""

import json
import os
import signal
import threading

import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from safe_wrappers.train.files import read_rows
from safe_wrappers.train.processes import RunStoppedError, StopRequest, stop_request, stopping
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run import callbacks as run_callbacks
from safe_wrappers.train.run.callbacks import EpisodeRows
from safe_wrappers.train.run.checkpoint import latest_checkpoint
from safe_wrappers.train.run.stack import make_stack
from safe_wrappers.train.run.training import standing

SILENT = Progress(lambda _: None, lambda _: None)
PPO = ("total_steps=512", "checkpoint_every=1000000")
SAC = (
    *PPO,
    "algorithm=SAC",
    "hyperparameters={learning_starts: 50, batch_size: 16, train_freq: 1000}",
    "n_envs=1",
)


@pytest.fixture
def stopped_at(fake_experiment, monkeypatch):
    """Trains a run that gets SIGTERM after so many steps; returns its arm, its folder and what it says."""

    def stop(steps, *overrides):
        ask = EpisodeRows._on_step

        def asking(self):
            if self.num_timesteps == steps:
                os.kill(os.getpid(), signal.SIGTERM)
            return ask(self)

        experiment = fake_experiment(*overrides)
        arm = experiment.arms[1]
        folder = experiment.run_folder(arm, 0)
        with monkeypatch.context() as patch:
            patch.setattr(EpisodeRows, "_on_step", asking)
            with pytest.raises(RunStoppedError) as stopped:
                train_run(arm, 0, folder, SILENT)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        return arm, folder, str(stopped.value)

    return stop


def load(arm, folder):
    envs = DummyVecEnv([lambda: make_stack(arm.env, arm.filter)] * arm.n_envs)
    checkpoint = latest_checkpoint(folder / "checkpoints", pytest.fail)
    return checkpoint.load_model(arm.algorithm, checkpoint.load_normalize(envs), "cpu")


def test_a_short_rollout_is_brought_to_its_end_and_learned_from(stopped_at):
    arm, folder, said = stopped_at(200, *PPO)
    assert said == "stopped; goes on from step 256"
    assert load(arm, folder)._n_updates == 2 * 2  # epochs of two rollouts
    assert standing(arm, folder) == "from step 256"


def test_a_long_rollout_is_given_up_as_if_it_had_not_begun(stopped_at, monkeypatch):
    monkeypatch.setattr(run_callbacks, "_PATIENCE_S", 0.0)
    arm, folder, said = stopped_at(200, *PPO)
    assert said == "stopped; goes on from step 128; 74 later steps will be made again"
    model = load(arm, folder)
    assert (model.num_timesteps, model._n_updates) == (128, 2)
    assert model.get_vec_normalize_env().obs_rms.count == pytest.approx(128, abs=3)
    train_run(arm, 0, folder, SILENT)
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 512
    steps = [row["timesteps"] for row in read_rows(folder / "episodes.csv")]
    assert steps == sorted(steps)
    assert len(steps) == 2 * (64 // 20) + 2 * (192 // 20)
    assert standing(arm, folder) == "finished"


def test_in_the_first_rollout_there_is_nothing_to_save(stopped_at, monkeypatch):
    monkeypatch.setattr(run_callbacks, "_PATIENCE_S", 0.0)
    arm, folder, said = stopped_at(20, *PPO)
    assert said == "stopped; goes on from the start; 22 later steps will be made again"
    assert not (folder / "checkpoints").exists()
    assert standing(arm, folder) == "from the start"
    train_run(arm, 0, folder, SILENT)


def test_sac_keeps_all_that_it_has_stored(stopped_at, monkeypatch):
    monkeypatch.setattr(run_callbacks, "_PATIENCE_S", 0.0)
    arm, folder, said = stopped_at(200, *SAC)
    assert said == "stopped; goes on from step 200; 1 later step will be made again"
    model = load(arm, folder)
    assert model.replay_buffer.size() == model.num_timesteps == 200


def test_a_second_signal_is_one_that_comes_later(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(stopping.time, "monotonic", lambda: now[0])
    request = StopRequest()
    for moment, expected in [(0.0, False), (0.1, False), (0.4, False), (0.6, True)]:
        now[0] = moment
        request.receive(signal.SIGTERM)
        assert (request.signum, request.at_once) == (signal.SIGTERM, expected)


def test_what_is_ignored_stays_ignored_and_all_is_put_back():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_request() as request:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not request.signum
            os.kill(os.getpid(), signal.SIGTERM)
            assert request.signum == signal.SIGTERM
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_than_the_main_one_goes_without():
    seen = []

    def block():
        with stop_request() as request:
            seen.append(request.signum)

    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    assert seen == [0]
