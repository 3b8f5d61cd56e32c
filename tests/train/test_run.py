"""One run in this process: where it resumes, what it refuses, what it leaves behind and sends to trackers."""

import json
import os
import random
import resource
import shutil
import signal
import sys
from unittest.mock import Mock

import numpy as np
import pytest
import stable_baselines3
import torch
from fake_task import FILMED, FakeGoal
from running import Reports, episodes, evaluated, finish, killed_after, resumed, scalars, trained
from stable_baselines3.common.vec_env import VecNormalize

from safe_wrappers.errors import RunStateError
from safe_wrappers.train.files import append_row, only_writer, read_rows, write_rows
from safe_wrappers.train.processes import Job, Progress, RunStoppedError, work
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model
from safe_wrappers.train.run.data_pickles import read_pickle
from safe_wrappers.train.run.trackers import run_logger
from safe_wrappers.train.run.training import finished_checkpoint

SAC = ("algorithm=SAC", "hyperparameters={learning_starts: 50, batch_size: 16, train_freq: 8}", "n_envs=1")


def test_a_half_written_last_row_is_none(tmp_path):
    path, columns = tmp_path / "episodes.csv", ("length", "success", "cost")
    assert read_rows(path) == []
    write_rows(path, columns, [{"length": 4, "success": True, "cost": 1.5}])
    append_row(path, columns, {"length": 12})
    for whole in (2, 1, 1):
        assert read_rows(path) == [{"length": 4.0, "success": 1.0, "cost": 1.5}, {"length": 12.0}][:whole]
        path.write_bytes(path.read_bytes()[:-1])
    for wrong in (b"a\nb\n", b"a\n1,2,3\n", b"a\n\xff\n"):
        path.write_bytes(wrong)
        with pytest.raises(RunStateError, match="is no table of numbers"):
            read_rows(path)


def test_a_file_is_the_old_one_or_the_new_one(tmp_path, monkeypatch):
    path = tmp_path / "episodes.csv"
    write_rows(path, ("cost",), [{"cost": 1.0}])

    def killed(file):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        write_rows(path, ("cost",), [{"cost": 2.0}])
    assert read_rows(path) == [{"cost": 1.0}]


def test_a_run_leaves_rows_logs_and_a_policy_and_is_not_run_again(finished):
    experiment = finished()
    folder = experiment.run_folder(experiment.arms[1], 0)
    rows = episodes(folder)
    assert len(rows) == 2 * (256 // 20) and {row["length"] for row in rows} == {20.0}
    assert {row["env"] for row in rows} == {0, 1}
    assert 0 < sum(row["intervention_rate"] for row in rows) < len(rows)
    assert sum(row["violations"] for row in rows) == 0
    assert finish(folder)["timesteps"] == 512
    assert finish(folder)["filter_time_us"] == pytest.approx(1.0)
    tags = {"interventions/rate", "interventions/step_rate", "rollout/ep_rew_mean", "train/loss"}
    assert tags <= scalars(folder).keys()

    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"}
    again = Reports()
    trained(experiment, progress=again.progress)
    assert again.steps == [512]
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"} == before


def test_same_seed_same_run_and_other_seed_other_run(kept, fake_experiment):
    experiment = fake_experiment("name=again", *FILMED)
    first, other = (episodes(kept.run_folder(kept.arms[1], seed)) for seed in (0, 1))
    assert episodes(trained(experiment)) == first != other


def test_neither_neighbouring_seeds_nor_the_parts_of_a_run_share_an_episode(fake_experiment, monkeypatch):
    starts, reset = [], FakeGoal.reset

    def noted(self, **options):
        observation, info = reset(self, **options)
        starts.append(tuple(observation))
        return observation, info

    monkeypatch.setattr(FakeGoal, "reset", noted)
    experiment, parts = fake_experiment(), []
    for train in (
        lambda: killed_after(experiment, 2),
        lambda: trained(experiment),
        lambda: trained(experiment, seed=1),
    ):
        starts.clear()
        train()
        parts.append(set(starts))
    assert all(len(part) > 10 for part in parts)
    assert len(set.union(*parts)) == sum(map(len, parts))


def test_a_killed_run_goes_on_from_its_last_checkpoint(fake_experiment, monkeypatch):
    rates, train = [], stable_baselines3.PPO.train

    def noting(self):
        train(self)
        rates.append((self.num_timesteps, self.policy.optimizer.param_groups[0]["lr"]))

    monkeypatch.setattr(stable_baselines3.PPO, "train", noting)
    experiment = fake_experiment(
        "total_steps=768", "normalize.reward=true", "hyperparameters.learning_rate=linear_1e-3"
    )
    folder = killed_after(experiment, 2)
    rows = episodes(folder)
    assert latest_checkpoint(folder / "checkpoints").timesteps == 256
    assert [row for row in rows if row["timesteps"] > 256]  # whose rows must not be counted twice
    with (folder / "episodes.csv").open("a") as file:
        file.write("300.0,1.0,20")  # the kill came in the middle of a line
    shutil.copytree(folder / "checkpoints" / "step_000000000128", folder / "checkpoints" / ".writing")
    scaling = resumed(experiment.arms[1], folder).get_vec_normalize_env()
    assert isinstance(scaling, VecNormalize) and scaling.norm_reward
    assert scaling.obs_rms.count == pytest.approx(256, abs=3)

    reports = Reports()
    trained(experiment, progress=reports.progress)
    assert reports.steps[0] > 256 and reports.steps[-1] == finish(folder)["timesteps"] == 768
    after = episodes(folder)
    kept = [row for row in after if row["timesteps"] <= 256]
    assert kept == [row for row in rows if row["timesteps"] <= 256]
    # 128 steps of either env before the checkpoint, 256 new ones after it, 20 steps an episode.
    assert len(after) == 2 * (128 // 20) + 2 * (256 // 20)
    # New episodes after the restart, not the first ones again; and the schedule goes on.
    assert not {row["return"] for row in after if row["timesteps"] > 256} & {row["return"] for row in kept}
    assert [steps for steps, _ in rates] == [128, 256, 384, 384, 512, 640, 768]
    assert [rate for _, rate in rates] == pytest.approx([1e-3 * (1 - steps / 768) for steps, _ in rates])
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == ["step_000000000768"]


def test_a_sac_run_keeps_its_replay_buffer_until_it_is_finished(fake_experiment, monkeypatch):
    experiment = fake_experiment(*SAC, "total_steps=320")
    folder = killed_after(experiment, 1)
    buffer = resumed(experiment.arms[1], folder).replay_buffer
    assert buffer.size() == latest_checkpoint(folder / "checkpoints").timesteps == 128
    assert buffer.buffer_size == 320  # not a million: it would be saved with every checkpoint
    trained(experiment)
    (final,) = (folder / "checkpoints").iterdir()
    assert final.name == "step_000000000320"
    assert not (final / "replay_buffer.pkl").exists()  # of no use to a finished run, and large
    assert resumed(experiment.arms[1], folder).replay_buffer.buffer_size == 100  # as much as it asks for

    # A kill between this checkpoint and the note that the run is finished, while its policy is written:
    scaling = folder / "policy" / "vecnormalize.pkl"
    before = vars(read_pickle(scaling).obs_rms)
    (folder / "finished.json").unlink()
    (folder / ".policy").mkdir()  # half of one
    trained(experiment)
    assert finish(folder)["timesteps"] == 320
    np.testing.assert_equal(vars(read_pickle(scaling).obs_rms), before)

    # Raised, it fills a new buffer before it learns.
    trained_at, train = [], stable_baselines3.SAC.train

    def noting(self, **given):
        trained_at.append(self.num_timesteps)
        train(self, **given)

    monkeypatch.setattr(stable_baselines3.SAC, "train", noting)
    reports = Reports()
    trained(fake_experiment(*SAC, "total_steps=400"), progress=reports.progress)
    (line,) = reports.lines
    assert line.startswith("goes on from step 320 with an empty replay buffer") and "50 steps" in line
    assert 370 < trained_at[0] <= 384 and finish(folder)["timesteps"] == 400


def test_the_price_on_cost_rises_where_there_is_a_limit_and_goes_on_from_a_checkpoint(fake_experiment):
    limit, prices = "arms.unfiltered.learner={cost_limit: 0, multiplier_rate: 0.01}", []
    for steps in (384, 512):
        folder = trained(fake_experiment(limit, f"total_steps={steps}"), 0)
        told = scalars(folder)["interventions/lagrangian_multiplier"]
        prices.append([value for at, value in told if at > 384 or steps == 384])
    # Each is what stood after a rollout; costs are never below the limit.
    assert 0.0 < prices[0][-1] <= prices[1][0]
    model = load_model(latest_checkpoint(folder / "checkpoints").folder, "PPO", "cpu")
    assert model.lagrangian_multiplier == pytest.approx(prices[1][-1])


def test_random_states_are_those_of_the_checkpoint(finished):
    """Not those of the run's seed, with which SB3 seeds everything when it loads a model."""
    experiment = finished()
    folder = experiment.run_folder(experiment.arms[1], 0)
    of_python, of_numpy = random.Random(5), np.random.RandomState(5)
    of_torch = torch.Generator().manual_seed(5)
    numbers = of_numpy.get_state(legacy=False)
    numbers["state"]["key"] = numbers["state"]["key"].tolist()
    states = {"python": of_python.getstate(), "numpy": numbers, "torch": of_torch.get_state().tolist()}
    path = latest_checkpoint(folder / "checkpoints").folder / "random.json"
    assert json.loads(path.read_text()).keys() == states.keys()
    path.write_text(json.dumps(states))
    resumed(experiment.arms[1], folder)
    assert random.random() == of_python.random() and np.random.normal() == of_numpy.normal()
    assert torch.equal(torch.rand(3), torch.rand(3, generator=of_torch))


def test_a_run_that_is_to_stop_saves_after_its_rollout_and_goes_on(fake_experiment):
    experiment = fake_experiment("total_steps=384", "checkpoint_every=1000000")
    folder = experiment.run_folder(experiment.arms[1], 0)
    stopping = Progress(print, print, stopping=lambda: (folder / "episodes.csv").stat().st_size > 900)
    with pytest.raises(RunStoppedError, match=r"stopped; goes on from step \d+") as stopped:
        trained(experiment, progress=stopping)
    reached = latest_checkpoint(folder / "checkpoints").timesteps
    assert str(stopped.value).endswith(f" {reached:,}") and 0 < reached < 384
    trained(experiment)
    assert finish(folder)["timesteps"] == 384
    assert episodes(folder)


def test_another_configs_folder_is_refused_and_the_difference_shown(finished):
    experiment = finished()
    folder = experiment.run_folder(experiment.arms[1], 0)
    with pytest.raises(RunStateError) as refusal:
        trained(finished("hyperparameters.n_steps=32", "total_steps=400", "hyperparameters.gamma=0.9"))
    assert str(refusal.value).splitlines()[1:-1] == [
        "  hyperparameters.gamma: 'unset' in the folder, 0.9 in the config",
        "  hyperparameters.n_steps: 64 in the folder, 32 in the config",
        "  total_steps: 512 in the folder, 400 in the config (it can be raised, not lowered)",
    ]
    # What does not change the learning may change.
    trained(finished("checkpoint_every=64", "workers=1", "evaluation.episodes=7", "seeds=[0]"))
    (folder / "run.json").write_text("{}")
    with pytest.raises(RunStateError, match=r"run.json' does not say what the run is of"):
        trained(experiment)


def test_the_total_of_a_finished_run_can_be_raised(fake_experiment):
    short = fake_experiment("evaluation.episodes=1", "total_steps=250")
    folder = trained(short)
    note = (folder / "finished.json").read_text()
    trained(fake_experiment("total_steps=255"))  # the last rollout had reached it anyway
    assert (folder / "finished.json").read_text() == note
    evaluated(fake_experiment("evaluation.episodes=1", "total_steps=255"))
    long = fake_experiment("evaluation.episodes=1", "total_steps=512")
    with pytest.raises(RunStateError, match="is not trained to its end"):
        finished_checkpoint(long.arms[1], 0, folder)
    trained(long)
    assert finished_checkpoint(long.arms[1], 0, folder).timesteps == 512
    assert len(episodes(folder)) == 4 * (128 // 20)
    # The older policy's evaluation is gone, also for who asks for a report and not for an evaluation.
    assert not (folder / "evaluation").exists()
    assert json.loads((folder / "policy" / "config.json").read_text())["timesteps"] == 512
    with pytest.raises(RunStateError, match=r"total_steps: 512 in the folder, 250 in the config"):
        trained(short)


def test_a_start_that_fails_leaves_the_folder_to_the_corrected_command(fake_experiment):
    wrong = fake_experiment("hyperparameters.policy=CnnPolicy")
    with pytest.raises(Exception, match="NatureCNN"):
        trained(wrong)
    assert not (wrong.run_folder(wrong.arms[1], 0) / "run.json").exists()
    falls = "{n_steps: 64, gamma: 0.9, clip_range: linear_0.2, policy_kwargs: {net_arch: [7]}}"
    folder = trained(fake_experiment(f"hyperparameters={falls}", "total_steps=128"))
    model = load_model(latest_checkpoint(folder / "checkpoints").folder, "PPO", "cpu")
    assert (model.gamma, model.n_steps, model.device.type) == (0.9, 64, "cpu")
    assert model.policy.mlp_extractor.latent_dim_pi == 7
    # The last rollout may end beyond the total: what falls does not go below 0.
    assert [model.clip_range(left) for left in (1.0, 0.25, 0.0, -0.1)] == pytest.approx([0.2, 0.05, 0.0, 0.0])


def test_a_checkpoint_that_cannot_be_read_is_named_and_without_it_the_one_before_counts(fake_experiment):
    experiment = fake_experiment("total_steps=640")
    folder = killed_after(experiment, 3)
    older, newer = sorted((folder / "checkpoints").glob("step_*"))
    model = newer / "model.zip"
    model.write_bytes(model.read_bytes()[:-100])
    with pytest.raises(RunStateError, match="the checkpoint before it") as refusal:
        trained(experiment)
    assert f"Delete {str(newer)!r}" in str(refusal.value)
    shutil.rmtree(newer)
    assert latest_checkpoint(folder / "checkpoints").folder == older
    trained(experiment)
    assert finish(folder)["timesteps"] == 640


def test_two_processes_do_not_train_one_run_and_a_killed_one_holds_no_folder(fake_experiment, monkeypatch):
    monkeypatch.setattr("safe_wrappers.train.files._PATIENCE_S", 0.0)
    experiment = fake_experiment("total_steps=128")
    hold = only_writer(experiment.run_folder(experiment.arms[1], 0))
    with hold, pytest.raises(RunStateError, match="Another process is working in"):
        trained(experiment)
    child = os.fork()
    if not child:
        held = only_writer(
            experiment.run_folder(experiment.arms[1], 0)
        )  # unnamed it would be let go of at once
        held.__enter__()
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    trained(experiment)


def test_a_file_that_cannot_be_written_is_named_and_the_last_checkpoint_stays(fake_experiment):
    """The kernel refuses to write more than so many bytes, as a full disk does: once for each size of a file."""
    folder = trained(fake_experiment(*SAC, "total_steps=128", "checkpoint_every=64"))
    at = folder / "checkpoints" / "step_000000000128"
    longer = fake_experiment(*SAC, "total_steps=192", "checkpoint_every=64")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    named = 0
    for size in sorted({path.stat().st_size for path in at.iterdir()}):
        job = Job("a run", 192, "steps", lambda progress: trained(longer, progress=progress), ())
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))
            told = work(job, lambda _: None, bool)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert "File too large" in told and "Traceback" not in told
        named += str(folder / "checkpoints") in told
        assert not (folder / "checkpoints" / ".writing").exists()  # what it took is free again
        assert latest_checkpoint(folder / "checkpoints").timesteps == 128
        assert resumed(longer.arms[1], folder).num_timesteps == 128
    assert named >= 2
    trained(longer, progress=Reports().progress)
    assert finish(folder)["timesteps"] == 192


# Curves and interventions in Weights & Biases and MLflow: by a fake, and where it is installed ----------------------

SENT = {"rollout/ep_rew_mean", "interventions/rate", "evaluation_filter_on/return"}


@pytest.fixture
def tracked(fake_experiment):
    return lambda tracker, steps=128: fake_experiment(
        f"total_steps={steps}", f"trackers=[{tracker}]", "evaluation.episodes=2"
    )


@pytest.fixture
def wandb(monkeypatch):
    """As if it were installed: `init` returns the run."""
    fake = Mock()
    fake.init.return_value = fake
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


def test_curves_and_interventions_of_training_and_evaluation_arrive(tracked, wandb):
    folder = trained(tracked("wandb"))
    evaluated(tracked("wandb"))
    assert SENT | {"timesteps"} <= {key for call in wandb.log.call_args_list for key in call.args[0]}
    made = [call.kwargs for call in wandb.init.call_args_list]
    assert {(one["project"], one["name"]) for one in made} == {("fake", "filtered seed 0")}
    assert wandb.finish.call_count == len(made) == 2
    # One run there: after a raised total, too; of another config another one.
    for seed in (0, 1):
        logger = run_logger(tracked("wandb", 256).arms[1], seed, folder)
        assert len({call.kwargs["id"] for call in wandb.init.call_args_list}) == 1 + seed
    # Nothing that is no finite number is sent.
    wandb.log.reset_mock()
    for key, value in (("a", float("nan")), ("b", "text"), ("c", 2.0)):
        logger.record(key, value)
    logger.record("d", 1.0, exclude="tensorboard")
    logger.dump(7)
    wandb.log.assert_called_once_with({"c": 2.0, "timesteps": 7})


def test_a_tracker_that_is_lost_stops_no_training(tracked, wandb):
    wandb.log.side_effect = OSError("no network")
    with pytest.warns(UserWarning, match="wandb: what follows is not tracked: no network") as said:
        folder = trained(tracked("wandb"))
    assert sum("wandb" in str(each.message) for each in said) == 1
    assert (folder / "finished.json").exists()


def test_mlflow_takes_it_in_a_folder(tracked, tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "mlruns").as_uri())
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    trained(tracked("mlflow"))
    evaluated(tracked("mlflow"))
    client = mlflow.MlflowClient()
    (run,) = client.search_runs([client.get_experiment_by_name("fake").experiment_id])
    assert run.data.metrics.keys() >= SENT
    assert run.data.params["algorithm"] == "PPO" and run.info.status == "FINISHED"
