"""One run in this process: where it resumes, what it refuses, what it leaves behind."""

import json
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
from rich.console import Console
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from safe_wrappers import CBFActionFilter, RecordInterventions
from safe_wrappers.errors import RunStateError, UnknownNameError
from safe_wrappers.sb3 import ExecutedActionDictReplayBuffer
from safe_wrappers.train import experiment as experiment_module
from safe_wrappers.train.config import EnvConfig, FilterConfig
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.experiment import train_experiment
from safe_wrappers.train.files import only_writer, read_rows
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run import checkpoint as checkpoint_module
from safe_wrappers.train.run.callbacks import CheckpointCallback
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model
from safe_wrappers.train.run.stack import make_stack
from safe_wrappers.train.run.training import finished_checkpoint
from safe_wrappers.train.videos.record import video_path

OFF = FilterConfig()


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
    facts = json.loads((folder / "finished.json").read_text())
    assert facts["timesteps"] == 512
    assert facts["filter_time_us"] == pytest.approx(1.0)
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"interventions/rate", "interventions/step_rate", "rollout/ep_rew_mean", "train/loss"} <= set(tags)


def test_a_finished_run_is_not_run_again(fake_experiment):
    experiment = fake_experiment()
    folder = run(experiment)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"}
    reports = Reports()
    run(experiment, reports=reports)
    assert reports.steps == [512]
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"} == before


def test_same_seed_same_run_and_other_seed_other_run(fake_experiment, tmp_path):
    first = read_rows(run(fake_experiment("name=a")) / "episodes.csv")
    assert first == read_rows(run(fake_experiment("name=b")) / "episodes.csv")
    assert first != read_rows(run(fake_experiment("name=c"), seed=1) / "episodes.csv")


def test_a_killed_run_goes_on_from_its_last_checkpoint(fake_experiment, monkeypatch):
    experiment = fake_experiment("total_steps=768")
    folder = run_killed_after(experiment, 2, monkeypatch)
    rows = read_rows(folder / "episodes.csv")
    checkpoint = latest_checkpoint(folder / "checkpoints")
    assert checkpoint.timesteps == 256
    late = [row for row in rows if row["timesteps"] > 256]
    assert late  # steps after the checkpoint, whose rows must not be counted twice
    with (folder / "episodes.csv").open("a") as file:
        file.write("300.0,1.0,20")  # the kill came in the middle of a line
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
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 768
    # New episodes after the restart, not the first ones again.
    fresh = [row["return"] for row in after if row["timesteps"] > 256]
    assert not set(fresh) & {row["return"] for row in kept}


def test_a_killed_sac_run_keeps_its_replay_buffer(fake_experiment, monkeypatch):
    experiment = fake_experiment(
        "algorithm=SAC",
        "hyperparameters={learning_starts: 50, batch_size: 16}",
        "total_steps=400",
        "n_envs=1",
    )
    folder = run_killed_after(experiment, 2, monkeypatch)
    checkpoint = latest_checkpoint(folder / "checkpoints")
    envs = checkpoint.load_normalize(
        DummyVecEnv([lambda: make_stack(experiment.arms[1].env, FilterConfig())])
    )
    model = checkpoint.load_model("SAC", envs, "cpu")
    assert model.replay_buffer.size() == checkpoint.timesteps == 256
    run(experiment)
    final = folder / "checkpoints" / "step_000000000400"
    assert [path.name for path in (folder / "checkpoints").iterdir()] == [final.name]
    assert not (final / "replay_buffer.pkl").exists()  # of no use to a finished run, and large
    # A kill between this checkpoint and the note that the run is finished:
    (folder / "finished.json").unlink()
    run(experiment)
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 400


def test_the_normaliser_goes_on_too(fake_experiment, monkeypatch):
    experiment = fake_experiment("total_steps=768", "normalize.reward=true")
    folder = run_killed_after(experiment, 1, monkeypatch)
    envs = DummyVecEnv([lambda: make_stack(experiment.arms[1].env, FilterConfig())] * 2)
    seen = latest_checkpoint(folder / "checkpoints").load_normalize(envs)
    assert isinstance(seen, VecNormalize)
    assert seen.norm_reward
    assert seen.obs_rms.count == pytest.approx(128, abs=3)
    run(experiment)
    seen = latest_checkpoint(folder / "checkpoints").load_normalize(envs)
    assert seen.obs_rms.count == pytest.approx(768, abs=6)


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


def test_the_total_of_a_finished_run_can_be_raised(fake_experiment):
    short = fake_experiment("evaluation.episodes=1")
    arm = short.arms[1]
    folder = run(short)
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
    evaluate_run(long, 0, folder, short.evaluation, arm.filter, Reports().progress)
    assert json.loads((folder / "evaluation" / "evaluation.json").read_text())["timesteps"] == 768
    with pytest.raises(RunStateError, match=r"total_steps: 768 in the folder, 512 in the config"):
        run(short)


def test_films_of_a_finished_run_that_goes_on_are_deleted(fake_experiment, monkeypatch):
    monkeypatch.setattr(experiment_module, "run_jobs", lambda *_, **__: None)
    short = fake_experiment("seeds=[0]")
    run(short)
    films = {arm.name: video_path(short, arm, "filter_on") for arm in short.arms}
    films["filtered"].parent.mkdir()
    for path in films.values():
        path.write_bytes(b"")
        path.with_suffix(".json").write_text("{}")
    train_experiment(short, Console())
    assert all(path.exists() for path in films.values())
    train_experiment(fake_experiment("seeds=[0]", "total_steps=768"), Console())
    left = sorted(path.name for path in films["filtered"].parent.iterdir())
    assert left == ["unfiltered_filter_on.json", "unfiltered_filter_on.webp"]  # it was not trained at all


def test_a_raised_total_that_the_last_rollout_had_reached_anyway_changes_nothing(fake_experiment):
    folder = run(fake_experiment("total_steps=500"))
    finished = (folder / "finished.json").read_text()
    run(fake_experiment("total_steps=510"))
    assert (folder / "finished.json").read_text() == finished
    assert json.loads((folder / "run.json").read_text())["config"]["total_steps"] == 510


SAC = ("algorithm=SAC", "hyperparameters={learning_starts: 50, batch_size: 16, train_freq: 8}", "n_envs=1")


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
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 400
    run(longer)  # the buffer's default size has grown with the total: no other config


def test_a_raised_total_of_an_unfinished_sac_run_moves_its_buffer_into_a_larger_one(
    fake_experiment, monkeypatch
):
    folder = run_killed_after(fake_experiment(*SAC, "total_steps=330"), 2, monkeypatch)
    checkpoint = latest_checkpoint(folder / "checkpoints")
    envs = checkpoint.load_normalize(DummyVecEnv([lambda: make_stack(fake_experiment().arms[0].env, OFF)]))
    kept = checkpoint.load_model("SAC", envs, "cpu").replay_buffer
    moved = checkpoint.load_model("SAC", envs, "cpu", buffer_size=400).replay_buffer
    assert (kept.buffer_size, moved.buffer_size) == (330, 400)
    assert kept.size() == moved.size() == checkpoint.timesteps == 256
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        assert np.array_equal(getattr(moved, name)[:256], getattr(kept, name)[:256]), name
    reports = Reports()
    run(fake_experiment(*SAC, "total_steps=400"), reports=reports)
    assert reports.lines == []


def test_a_full_buffer_is_moved_oldest_first_with_all_that_is_in_it():
    box = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    space = gym.spaces.Dict({"a": box, "b": box})
    old, new = (ExecutedActionDictReplayBuffer(size, space, box, "cpu", mode="both") for size in (4, 6))
    stored = np.array([4, 5, 2, 3])
    old.rewards[:, 0] = old.executed_actions[:, 0, 0] = old.next_observations["b"][:, 0, 1] = stored
    old.pos, old.full = 2, True
    checkpoint_module._move(old, new)
    assert (new.pos, new.full) == (4, False)
    for array in (new.rewards[:4, 0], new.executed_actions[:4, 0, 0], new.next_observations["b"][:4, 0, 1]):
        assert array.tolist() == [2.0, 3.0, 4.0, 5.0]


def test_a_start_that_fails_leaves_the_folder_to_the_corrected_command(fake_experiment):
    wrong = fake_experiment("hyperparameters.policy=CnnPolicy")
    with pytest.raises(Exception, match="NatureCNN"):
        run(wrong)
    assert not (wrong.run_folder(wrong.arms[1], 0) / "run.json").exists()
    run(fake_experiment())


def test_a_folder_without_its_run_file_is_refused(fake_experiment):
    folder = run(fake_experiment())
    (folder / "run.json").unlink()
    with pytest.raises(RunStateError, match=r"has checkpoints but no run.json that says what they are of"):
        run(fake_experiment())
    (folder / "run.json").write_text("{")
    with pytest.raises(RunStateError, match=r"run.json' is unreadable; delete"):
        run(fake_experiment())


def test_a_corrupted_checkpoint_falls_back_to_the_one_before(fake_experiment, monkeypatch):
    experiment = fake_experiment("total_steps=768")
    folder = run_killed_after(experiment, 3, monkeypatch)
    older, newer = sorted((folder / "checkpoints").glob("step_*"))
    model = newer / "model.zip"
    model.write_bytes(model.read_bytes()[:-100])
    reports = Reports()
    run(experiment, reports=reports)
    (line,) = reports.lines
    assert str(model) in line
    assert f"continuing from the checkpoint before it, {older}" in line
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 768


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda c: (c / "model.zip").write_bytes(b"x"),
            "model.zip is not as it was written (its checksum differs)",
        ),
        (lambda c: (c / "random.json").unlink(), "random.json is missing"),
        (lambda c: (c / "state.json").write_text("{"), "state.json is missing or unreadable"),
    ],
)
def test_no_whole_checkpoint_left(fake_experiment, monkeypatch, damage, message):
    experiment = fake_experiment()
    folder = run_killed_after(experiment, 1, monkeypatch)
    damage(folder / "checkpoints" / "step_000000000128")
    with pytest.raises(RunStateError) as refusal:
        run(experiment)
    text = str(refusal.value)
    assert text.startswith("Corrupted checkpoint: ")
    assert message in text
    assert f"No other is left: delete {str(folder)!r} to train this run again from the start." in text
    shutil.rmtree(folder)
    run(experiment)


def test_a_half_written_checkpoint_is_no_checkpoint(fake_experiment, monkeypatch):
    experiment = fake_experiment()
    folder = run_killed_after(experiment, 1, monkeypatch)
    shutil.copytree(folder / "checkpoints" / "step_000000000128", folder / "checkpoints" / ".writing")
    (folder / "checkpoints" / ".writing" / "model.zip").unlink()
    run(experiment)
    assert not (folder / "checkpoints" / ".writing").exists()


def test_two_processes_do_not_train_one_run(fake_experiment):
    experiment = fake_experiment()
    with (
        only_writer(experiment.run_folder(experiment.arms[1], 0)),
        pytest.raises(RunStateError, match="Another process is working on the run in"),
    ):
        run(experiment)


def test_an_unfinished_or_damaged_policy_is_not_evaluated(fake_experiment):
    experiment = fake_experiment()
    arm = experiment.arms[1]
    folder = experiment.run_folder(arm, 0)
    with pytest.raises(RunStateError, match=r"is not trained to its end; run `safe-wrappers train`"):
        finished_checkpoint(arm, 0, folder)
    run(experiment)
    assert finished_checkpoint(arm, 0, folder).timesteps == 512
    (folder / "checkpoints" / "step_000000000512" / "vecnormalize.pkl").write_bytes(b"")
    with pytest.raises(RunStateError, match=r"vecnormalize.pkl is not as it was written"):
        finished_checkpoint(arm, 0, folder)
    shutil.rmtree(folder / "checkpoints")
    with pytest.raises(RunStateError, match=r"checkpoints' is empty; delete"):
        finished_checkpoint(arm, 0, folder)


def test_unknown_factories(fake_experiment):
    env = fake_experiment().arms[0].env
    with pytest.raises(
        UnknownNameError, match=r"fake_task.py\): unknown name 'sheild'. Did you mean 'shield'"
    ):
        make_stack(env, FilterConfig(factory="fake_task:sheild"))
    with pytest.raises(ValueError, match=r"filter.factory: cannot import 'no_such_module'") as refusal:
        make_stack(env, FilterConfig(factory="no_such_module:f"))
    looked = str(refusal.value).split(" and in ")[1]
    assert str(Path(__file__).parent) in looked
    assert "site-packages" not in looked


def test_protect_is_the_filter_and_gets_its_settings():
    env = make_stack(EnvConfig("SafePointGoal1-v0"), FilterConfig(protect={"margin": 0.25, "solver": "daqp"}))
    assert isinstance(env, Monitor)
    assert isinstance(env.env, RecordInterventions)
    assert isinstance(env.env.env, CBFActionFilter)
    assert env.env.env.spec.additional_wrappers[-1].kwargs["margin"] == 0.25
    env.reset(seed=0)
    _, _, _, _, info = env.step(np.ones(2, np.float32))
    assert {"cbf/intervened", "cost", "cost_substep", "goals_reached"} <= set(info)
    assert env.get_wrapper_attr("filter_time_us") > 0


def test_a_protected_run_on_the_real_task(fake_experiment):
    experiment = fake_experiment(
        "env=SafePointGoal1-v0", "arms={filtered: {filter: protect}}", "total_steps=1024", "n_envs=1"
    )
    (row,) = read_rows(run(experiment, arm=0) / "episodes.csv")
    assert (row["length"], row["cost"], row["cost_substep"], row["violations"]) == (1000.0, 0.0, 0.0, 0.0)
    assert row["goals_reached"] >= 0


def test_hyperparameters_and_device_reach_the_model(fake_experiment):
    experiment = fake_experiment("hyperparameters.gamma=0.9", "hyperparameters.policy_kwargs={net_arch: [7]}")
    folder = run(experiment)
    model = load_model(latest_checkpoint(folder / "checkpoints").folder, "PPO", "cpu")
    assert (model.gamma, model.n_steps, model.device.type) == (0.9, 64, "cpu")
    assert model.policy.mlp_extractor.latent_dim_pi == 7
    assert np.isfinite(model.predict(np.zeros(2))[0]).all()
