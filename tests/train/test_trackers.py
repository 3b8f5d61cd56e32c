"""Curves and interventions in Weights & Biases and MLflow: by fakes, and offline where they are installed."""

import importlib.util
import sys
import types

import pytest
from running import evaluated, trained

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.run.trackers import check_trackers, run_logger


class FakeWandb(types.SimpleNamespace):
    """As much of wandb as is used: what was logged, and by which id."""

    def __init__(self):
        super().__init__(inits=[], logged=[], finished=0, define_metric=lambda name, step_metric=None: None)

    def init(self, **settings):
        self.inits.append(settings)
        return self

    def log(self, values):
        self.logged.append(values)

    def finish(self):
        self.finished += 1


@pytest.fixture
def wandb(monkeypatch):
    """As if it were installed."""
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


@pytest.fixture
def tracked(fake_experiment):
    return lambda tracker, steps=128: fake_experiment(
        f"total_steps={steps}", f"trackers=[{tracker}]", "evaluation.episodes=2"
    )


SENT = {"rollout/ep_rew_mean", "interventions/rate", "evaluation_filter_on/return"}


def test_curves_and_interventions_of_training_and_evaluation_arrive(tracked, wandb):
    folder = trained(tracked("wandb"))
    evaluated(tracked("wandb"))
    assert SENT | {"timesteps"} <= {key for values in wandb.logged for key in values}
    assert {(one["project"], one["name"]) for one in wandb.inits} == {("fake", "filtered seed 0")}
    assert wandb.finished == len(wandb.inits) == 2
    # One run there: after a raised total, too; of another config another one.
    for seed in (0, 1):
        logger = run_logger(tracked("wandb", 256).arms[1], seed, folder)
        assert len({one["id"] for one in wandb.inits}) == 1 + seed
    # Nothing that is no finite number is sent.
    wandb.logged.clear()
    for key, value in (("a", float("nan")), ("b", "text"), ("c", 2.0)):
        logger.record(key, value)
    logger.record("d", 1.0, exclude="tensorboard")
    logger.dump(7)
    assert wandb.logged == [{"c": 2.0, "timesteps": 7}]


def test_a_tracker_that_is_lost_stops_no_training(tracked, wandb):
    def fail(*_, **__):
        raise OSError("no network")

    wandb.log = fail
    with pytest.warns(UserWarning, match="wandb: what follows is not tracked: no network") as said:
        folder = trained(tracked("wandb"))
    assert sum("wandb" in str(each.message) for each in said) == 1
    assert (folder / "finished.json").exists()


def test_what_is_not_installed_is_refused(tracked, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None)
    with pytest.raises(ConfigurationError, match=r"wandb is not .*pip install 'safe-wrappers\[wandb\]'"):
        check_trackers(tracked("wandb").arms[1])


# The packages themselves, offline ----------------------------------------------------------------------------------


def test_wandb_takes_it_offline(tracked, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    (run,) = (trained(tracked("wandb")) / "wandb").glob("offline-run-*")
    assert list(run.glob("*.wandb"))


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
