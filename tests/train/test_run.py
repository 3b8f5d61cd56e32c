"""One run in this process: where it resumes, what it refuses, what it leaves behind."""

import json
import random
import resource
import shutil

import numpy as np
import pytest
import stable_baselines3
import torch
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from safe_wrappers import CBFActionFilter, RecordInterventions
from safe_wrappers.errors import RunStateError
from safe_wrappers.train.config import EnvConfig, FilterConfig
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.files import only_writer, read_rows
from safe_wrappers.train.processes import Job, RunStoppedError, work
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model, resume
from safe_wrappers.train.run.data_pickles import read_pickle
from safe_wrappers.train.run.stack import make_stack, make_vec_env
from safe_wrappers.train.run.training import CheckpointCallback, finished_checkpoint


class Killed(BaseException):
    """Stands for the end of the process."""


class Reports:
    def __init__(self):
        self.steps, self.lines = [], []
        self.progress = Progress(self.steps.append, self.lines.append)


def run(experiment, arm=1, seed=0, reports=None):
    """Trains one run of the experiment; returns its folder."""
    config = experiment.arms[arm]
    folder = experiment.run_folder(config, seed)
    train_run(config, seed, folder, (reports or Reports()).progress)
    return folder


def run_killed_after(experiment, checkpoints, monkeypatch, arm=1):
    """Trains until some checkpoints are there, and 64 steps more, as a kill would leave it."""
    calls = []
    step = CheckpointCallback._on_step

    def counting(self):
        if len(calls) == checkpoints and self.num_timesteps - self._last >= 64:
            raise Killed
        return step(self)

    start = CheckpointCallback._on_rollout_start

    def saving(self):
        before = self._last
        start(self)
        if self._last != before:
            calls.append(self._last)

    with monkeypatch.context() as patch:
        patch.setattr(CheckpointCallback, "_on_step", counting)
        patch.setattr(CheckpointCallback, "_on_rollout_start", saving)
        with pytest.raises(Killed):
            run(experiment, arm)
    return experiment.run_folder(experiment.arms[arm], 0)


def resumed(arm, folder):
    """The model of the newest checkpoint, as a run goes on with it."""
    checkpoint = latest_checkpoint(folder / "checkpoints")
    return resume(checkpoint.folder, arm.algorithm, make_vec_env(arm), "cpu", 100)


def finished(folder):
    return json.loads((folder / "finished.json").read_text())


def test_a_run_leaves_rows_logs_and_a_policy(fake_experiment):
    experiment = fake_experiment()
    reports = Reports()
    folder = run(experiment, reports=reports)
    rows = read_rows(folder / "episodes.csv")
    assert len(rows) == 2 * (256 // 20)
    assert {row["length"] for row in rows} == {20.0}
    assert sum(row["intervention_rate"] for row in rows) > 0
    assert sum(row["violations"] for row in rows) == 0
    assert reports.steps[-1] == 512
    assert finished(folder)["timesteps"] == 512
    assert finished(folder)["filter_time_us"] == pytest.approx(1.0)
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"interventions/rate", "interventions/step_rate", "rollout/ep_rew_mean", "train/loss"} <= set(tags)
    # It is not run again.
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"}
    run(experiment, reports=(again := Reports()))
    assert again.steps == [512]
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"} == before


def test_same_seed_same_run_and_other_seed_other_run(fake_experiment):
    first = read_rows(run(fake_experiment("name=a")) / "episodes.csv")
    assert first == read_rows(run(fake_experiment("name=b")) / "episodes.csv")
    assert first != read_rows(run(fake_experiment("name=c"), seed=1) / "episodes.csv")


def test_a_killed_run_goes_on_from_its_last_checkpoint(fake_experiment, monkeypatch):
    experiment = fake_experiment("total_steps=768", "normalize.reward=true")
    folder = run_killed_after(experiment, 2, monkeypatch)
    rows = read_rows(folder / "episodes.csv")
    assert latest_checkpoint(folder / "checkpoints").timesteps == 256
    assert [row for row in rows if row["timesteps"] > 256]  # whose rows must not be counted twice
    with (folder / "episodes.csv").open("a") as file:
        file.write("300.0,1.0,20")  # the kill came in the middle of a line
    shutil.copytree(folder / "checkpoints" / "step_000000000128", folder / "checkpoints" / ".writing")
    scaling = resumed(experiment.arms[1], folder).get_vec_normalize_env()
    assert isinstance(scaling, VecNormalize) and scaling.norm_reward
    assert scaling.obs_rms.count == pytest.approx(256, abs=3)
    reports = Reports()
    run(experiment, reports=reports)
    assert reports.steps[0] > 256
    after = read_rows(folder / "episodes.csv")
    kept = [row for row in after if row["timesteps"] <= 256]
    assert kept == [row for row in rows if row["timesteps"] <= 256]
    steps = [row["timesteps"] for row in after]
    assert steps == sorted(steps)
    # 128 steps of either env before the checkpoint, 256 new ones after it, 20 steps an episode.
    assert len(after) == 2 * (128 // 20) + 2 * (256 // 20)
    assert finished(folder)["timesteps"] == 768
    # New episodes after the restart, not the first ones again.
    fresh = [row["return"] for row in after if row["timesteps"] > 256]
    assert not set(fresh) & {row["return"] for row in kept}
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == ["step_000000000768"]


SAC = ("algorithm=SAC", "hyperparameters={learning_starts: 50, batch_size: 16, train_freq: 8}", "n_envs=1")


def test_a_killed_sac_run_keeps_its_replay_buffer(fake_experiment, monkeypatch):
    experiment = fake_experiment(*SAC, "total_steps=400")
    folder = run_killed_after(experiment, 2, monkeypatch)
    buffer = resumed(experiment.arms[1], folder).replay_buffer
    assert buffer.size() == latest_checkpoint(folder / "checkpoints").timesteps == 256
    assert buffer.buffer_size == 400  # not a million: it would be saved with every checkpoint
    run(experiment)
    final = folder / "checkpoints" / "step_000000000400"
    assert [path.name for path in (folder / "checkpoints").iterdir()] == [final.name]
    assert not (final / "replay_buffer.pkl").exists()  # of no use to a finished run, and large
    # A kill between this checkpoint and the note that the run is finished:
    scaling = folder / "policy" / "vecnormalize.pkl"
    before = vars(read_pickle(scaling).obs_rms)
    (folder / "finished.json").unlink()
    run(experiment)
    assert finished(folder)["timesteps"] == 400
    np.testing.assert_equal(vars(read_pickle(scaling).obs_rms), before)


def test_random_states_go_on_where_they_stood(fake_experiment):
    experiment = fake_experiment("total_steps=128")
    folder = run(experiment)

    def drawn():
        resumed(experiment.arms[1], folder)
        return random.random(), np.random.normal(), torch.rand(1).item()

    first = drawn()
    random.seed(1), np.random.seed(1), torch.manual_seed(1)
    assert drawn() == first and len(set(first)) == 3


@pytest.mark.parametrize("settings", [(), SAC], ids=["PPO", "SAC"])
def test_a_run_that_is_to_stop_saves_after_its_rollout_and_goes_on(fake_experiment, settings):
    experiment = fake_experiment(*settings, "total_steps=512", "checkpoint_every=1000000")
    arm = experiment.arms[1]
    folder = experiment.run_folder(arm, 0)
    steps = [0]
    progress = Progress(steps.append, print, stopping=lambda: (folder / "episodes.csv").stat().st_size > 900)
    with pytest.raises(RunStoppedError, match=r"stopped; goes on from step \d+") as stopped:
        train_run(arm, 0, folder, progress)
    reached = latest_checkpoint(folder / "checkpoints").timesteps
    assert str(stopped.value).endswith(f" {reached:,}") and 0 < reached < 512
    assert resumed(arm, folder).num_timesteps == reached
    run(experiment)
    assert finished(folder)["timesteps"] == 512
    rows = [row["timesteps"] for row in read_rows(folder / "episodes.csv")]
    assert rows == sorted(rows)


def test_another_configs_folder_is_refused_and_the_difference_shown(fake_experiment):
    folder = run(fake_experiment())
    with pytest.raises(RunStateError) as refusal:
        run(fake_experiment("hyperparameters.n_steps=32", "total_steps=400", "hyperparameters.gamma=0.9"))
    assert str(refusal.value).splitlines() == [
        f"The run folder {str(folder)!r} belongs to another config:",
        "  hyperparameters.gamma: 'unset' in the folder, 0.9 in the config",
        "  hyperparameters.n_steps: 64 in the folder, 32 in the config",
        "  total_steps: 512 in the folder, 400 in the config (it can be raised, not lowered)",
        "Choose another `name` or `output`, go back to its settings, or delete the folder.",
    ]
    # What does not change the learning may change.
    run(fake_experiment("checkpoint_every=64", "workers=1", "evaluation.episodes=7", "seeds=[0]"))
    (folder / "run.json").write_text("{}")
    with pytest.raises(RunStateError, match=r"run.json' does not say what the run is of"):
        run(fake_experiment())


def test_the_total_of_a_finished_run_can_be_raised(fake_experiment):
    short = fake_experiment("evaluation.episodes=1", "total_steps=500")
    folder = run(short)
    note = (folder / "finished.json").read_text()
    run(fake_experiment("total_steps=510"))  # the last rollout had reached it anyway
    assert (folder / "finished.json").read_text() == note
    arm = fake_experiment("total_steps=510").arms[1]
    evaluate_run(arm, 0, folder, short.evaluation, arm.filter, Reports().progress)
    long = fake_experiment("evaluation.episodes=1", "total_steps=768").arms[1]
    with pytest.raises(RunStateError, match="is not trained to its end"):
        finished_checkpoint(long, 0, folder)
    run(fake_experiment("total_steps=768"))
    assert finished_checkpoint(long, 0, folder).timesteps == 768
    rows = read_rows(folder / "episodes.csv")
    assert [row["timesteps"] for row in rows] == sorted(row["timesteps"] for row in rows)
    assert len(rows) == 2 * (256 // 20) + 2 * (128 // 20)
    # The older policy's evaluation is gone, also for who asks for a report and not for an evaluation.
    assert not (folder / "evaluation").exists()
    assert json.loads((folder / "policy" / "config.json").read_text())["timesteps"] == 768
    with pytest.raises(RunStateError, match=r"total_steps: 768 in the folder, 500 in the config"):
        run(short)


def test_a_raised_total_of_a_finished_sac_run_fills_a_new_buffer_first(fake_experiment, monkeypatch):
    run(fake_experiment(*SAC, "total_steps=200"))
    trained_at = []
    train = stable_baselines3.SAC.train
    monkeypatch.setattr(
        stable_baselines3.SAC,
        "train",
        lambda self, **given: (trained_at.append(self.num_timesteps), train(self, **given)),
    )
    reports = Reports()
    longer = fake_experiment(*SAC, "total_steps=400")
    folder = run(longer, reports=reports)
    (line,) = reports.lines
    assert line.startswith("goes on from step 200 with an empty replay buffer")
    assert "50 steps of random actions (learning_starts)" in line
    assert 250 < trained_at[0] <= 264
    assert finished(folder)["timesteps"] == 400


def test_a_start_that_fails_leaves_the_folder_to_the_corrected_command(fake_experiment):
    wrong = fake_experiment("hyperparameters.policy=CnnPolicy")
    with pytest.raises(Exception, match="NatureCNN"):
        run(wrong)
    assert not (wrong.run_folder(wrong.arms[1], 0) / "run.json").exists()
    run(fake_experiment())


def test_a_checkpoint_that_cannot_be_read_is_named_and_without_it_the_one_before_counts(
    fake_experiment, monkeypatch
):
    experiment = fake_experiment("total_steps=768")
    folder = run_killed_after(experiment, 3, monkeypatch)
    older, newer = sorted((folder / "checkpoints").glob("step_*"))
    model = newer / "model.zip"
    model.write_bytes(model.read_bytes()[:-100])
    with pytest.raises(RunStateError, match="the checkpoint before it") as refusal:
        run(experiment)
    assert f"Delete {str(newer)!r}" in str(refusal.value)
    shutil.rmtree(newer)
    assert latest_checkpoint(folder / "checkpoints").folder == older
    run(experiment)
    assert finished(folder)["timesteps"] == 768


def test_two_processes_do_not_train_one_run(fake_experiment, monkeypatch):
    monkeypatch.setattr("safe_wrappers.train.files._PATIENCE_S", 0.0)
    experiment = fake_experiment()
    with (
        only_writer(experiment.run_folder(experiment.arms[1], 0)),
        pytest.raises(RunStateError, match="Another process is working in"),
    ):
        run(experiment)


def test_protect_is_the_filter_and_gets_its_settings():
    env = make_stack(EnvConfig("SafePointGoal1-v0"), FilterConfig(protect={"margin": 0.25}))
    assert isinstance(env, Monitor)
    assert isinstance(env.env, RecordInterventions)
    assert isinstance(env.env.env, CBFActionFilter)
    assert env.env.env.spec.additional_wrappers[-1].kwargs["margin"] == 0.25
    env.reset(seed=0)
    _, _, _, _, info = env.step(np.ones(2, np.float32))
    assert {"cbf/intervened", "cost", "cost_substep", "goals_reached"} <= set(info)
    assert env.get_wrapper_attr("filter_time_us") > 0


def test_hyperparameters_and_device_reach_the_model(fake_experiment):
    falls = "{n_steps: 64, gamma: 0.9, clip_range: linear_0.2, policy_kwargs: {net_arch: [7]}}"
    folder = run(fake_experiment(f"hyperparameters={falls}", "total_steps=500"))
    model = load_model(latest_checkpoint(folder / "checkpoints").folder, "PPO", "cpu")
    assert (model.gamma, model.n_steps, model.device.type) == (0.9, 64, "cpu")
    assert model.policy.mlp_extractor.latent_dim_pi == 7
    # The last rollout may end beyond the total: what falls does not go below 0.
    assert [model.clip_range(left) for left in (1.0, 0.25, 0.0, -0.1)] == pytest.approx([0.2, 0.05, 0.0, 0.0])


def test_a_continued_run_goes_on_with_its_schedule(fake_experiment, monkeypatch):
    rates = []
    train = stable_baselines3.PPO.train

    def noting(self):
        train(self)
        rates.append((self.num_timesteps, self.policy.optimizer.param_groups[0]["lr"]))

    monkeypatch.setattr(stable_baselines3.PPO, "train", noting)
    experiment = fake_experiment("hyperparameters.learning_rate=linear_1e-3")
    run_killed_after(experiment, 1, monkeypatch)
    run(experiment)
    assert [steps for steps, _ in rates] == [128, 256, 384, 512]
    assert [rate for _, rate in rates] == pytest.approx([1e-3 * (1 - steps / 512) for steps, _ in rates])


def test_a_file_that_cannot_be_written_is_named_and_the_last_checkpoint_stays(fake_experiment):
    """The kernel refuses to write more than so many bytes, as a full disk does: once for each size of a file."""
    folder = run(fake_experiment(*SAC, "total_steps=128", "checkpoint_every=64"))
    at = folder / "checkpoints" / "step_000000000128"
    longer = fake_experiment(*SAC, "total_steps=256", "checkpoint_every=64")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    named = 0
    for size in sorted({path.stat().st_size for path in at.iterdir()}):
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))
            told = work(Job("a run", 256, "steps", lambda _: run(longer), ()), lambda _: None, bool)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert "File too large" in told and "Traceback" not in told
        named += str(folder / "checkpoints") in told
        assert not (folder / "checkpoints" / ".writing").exists()  # what it took is free again
        assert latest_checkpoint(folder / "checkpoints").timesteps == 128
        assert resumed(longer.arms[1], folder).num_timesteps == 128
    assert named >= 2
    run(longer)
    assert finished(folder)["timesteps"] == 256
