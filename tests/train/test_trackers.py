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
        super().__init__(inits=[], logged=[], finished=0)

    def init(self, **settings):
        self.inits.append(settings)
        return self

    def define_metric(self, name, step_metric=None):
        pass

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


def tracked(fake_experiment, tracker, steps=128):
    return fake_experiment(f"total_steps={steps}", f"trackers=[{tracker}]", "evaluation.episodes=2")


def test_curves_and_interventions_of_training_and_evaluation_arrive(fake_experiment, wandb):
    experiment = tracked(fake_experiment, "wandb")
    folder = trained(experiment)
    evaluated(experiment)
    sent = {key: value for values in wandb.logged for key, value in values.items()}
    for key in ("rollout/ep_rew_mean", "interventions/rate", "evaluation_filter_on/return", "timesteps"):
        assert key in sent
    assert {(one["project"], one["name"]) for one in wandb.inits} == {("fake", "filtered seed 0")}
    assert wandb.finished == len(wandb.inits) == 2
    # One run there: after a raised total, too; of another config another one.
    for seed in (0, 1):
        logger = run_logger(tracked(fake_experiment, "wandb", 256).arms[1], seed, folder)
        assert len({one["id"] for one in wandb.inits}) == 1 + seed
    # Nothing that is no finite number is sent.
    wandb.logged.clear()
    for key, value in (("a", float("nan")), ("b", "text"), ("c", 2.0)):
        logger.record(key, value)
    logger.record("d", 1.0, exclude="tensorboard")
    logger.dump(7)
    assert wandb.logged == [{"c": 2.0, "timesteps": 7}]


def test_a_tracker_that_is_lost_stops_no_training(fake_experiment, wandb):
    def fail(*_, **__):
        raise OSError("no network")

    wandb.log = fail
    with pytest.warns(UserWarning, match="wandb: what follows is not tracked: no network") as said:
        folder = trained(tracked(fake_experiment, "wandb"))
    assert sum("wandb" in str(each.message) for each in said) == 1
    assert (folder / "finished.json").exists()


def test_what_is_not_installed_or_does_not_exist_is_refused(fake_experiment, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None)
    with pytest.raises(ConfigurationError, match=r"wandb is not .*pip install 'safe-wrappers\[wandb\]'"):
        check_trackers(tracked(fake_experiment, "wandb").arms[1])
    with pytest.raises(ConfigurationError, match="input should be 'wandb' or 'mlflow'"):
        tracked(fake_experiment, "wand")


# The packages themselves, offline ----------------------------------------------------------------------------------


def test_wandb_takes_it_offline(fake_experiment, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    (run,) = (trained(tracked(fake_experiment, "wandb")) / "wandb").glob("offline-run-*")
    assert list(run.glob("*.wandb"))


def test_mlflow_takes_it_in_a_folder(fake_experiment, tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "mlruns").as_uri())
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    experiment = tracked(fake_experiment, "mlflow")
    trained(experiment)
    evaluated(experiment)
    client = mlflow.MlflowClient()
    (run,) = client.search_runs([client.get_experiment_by_name("fake").experiment_id])
    assert {"interventions/rate", "evaluation_filter_on/return"} <= run.data.metrics.keys()
    assert run.data.params["algorithm"] == "PPO" and run.info.status == "FINISHED"
