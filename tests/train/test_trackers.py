"""Curves, interventions and films in Weights & Biases and MLflow: by fakes, and offline where they are installed."""

import importlib.util
import io
import json
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from test_run import Reports

from safe_wrappers.errors import ConfigurationError, RunStateError, UnknownNameError
from safe_wrappers.train import experiment as experiment_module
from safe_wrappers.train.config import EvaluationConfig
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.run.trackers import check_trackers, run_logger, track_film
from safe_wrappers.train.run.training import train_run


class FakeWandb(types.SimpleNamespace):
    """As much of wandb as is used: what was logged, and by which id."""

    def __init__(self):
        super().__init__(inits=[], logged=[], finished=0, metrics=[])
        self.Video = lambda path, format: (Image.open(path).n_frames, format)

    def init(self, **settings):
        self.inits.append(settings)
        return self

    def define_metric(self, name, step_metric=None):
        self.metrics.append((name, step_metric))

    def log(self, values):
        self.logged.append(values)

    def finish(self):
        self.finished += 1


class FakeMlflow(types.SimpleNamespace):
    """As much of MLflow as is used."""

    def __init__(self):
        super().__init__(experiments={}, runs={}, metrics=[], artifacts=[], params={})
        self.entities = types.SimpleNamespace(Metric=lambda *values: values)

    def MlflowClient(self):  # noqa: N802
        return self

    def get_experiment_by_name(self, name):
        found = self.experiments.get(name)
        return None if found is None else types.SimpleNamespace(experiment_id=found)

    def create_experiment(self, name):
        return self.experiments.setdefault(name, f"experiment {name}")

    def create_run(self, experiment_id, run_name, tags):
        assert experiment_id in self.experiments.values()
        self.runs[f"id {len(self.runs)}"] = "RUNNING"
        return types.SimpleNamespace(info=types.SimpleNamespace(run_id=f"id {len(self.runs) - 1}"))

    def update_run(self, run_id, status):
        assert self.runs[run_id] == "FINISHED"
        self.runs[run_id] = status

    def set_terminated(self, run_id):
        self.runs[run_id] = "FINISHED"

    def log_param(self, run_id, key, value):
        self.params[key] = value

    def log_batch(self, run_id, metrics):
        assert self.runs[run_id] == "RUNNING"
        self.metrics += metrics

    def log_artifact(self, run_id, path, folder):
        self.artifacts.append((folder, path))


@pytest.fixture
def fakes(monkeypatch):
    """Both trackers, as if they were installed."""
    made = {"wandb": FakeWandb(), "mlflow": FakeMlflow()}
    for name, fake in made.items():
        monkeypatch.setitem(sys.modules, name, fake)
    return made


def tracked(fake_experiment, *trackers, steps=128):
    arm = fake_experiment(f"total_steps={steps}", f"trackers=[{', '.join(trackers)}]").arms[1]
    assert arm.trackers == list(trackers)
    return arm


def film(path):
    data = io.BytesIO()
    frames = [Image.fromarray(np.full((20, 30, 3), 40 * i, np.uint8)) for i in range(5)]
    frames[0].save(data, "WEBP", save_all=True, append_images=frames[1:])
    path.write_bytes(data.getvalue())
    return path


def test_curves_and_interventions_of_training_and_evaluation_arrive_in_both(fake_experiment, fakes, tmp_path):
    arm, folder = tracked(fake_experiment, "wandb", "mlflow"), tmp_path / "fake" / "filtered" / "seed_0"
    train_run(arm, 0, folder, Reports().progress)
    evaluate_run(arm, 0, folder, EvaluationConfig(2, 7), arm.filter, Reports().progress)
    by_wandb = {key: value for values in fakes["wandb"].logged for key, value in values.items()}
    by_mlflow = {name: value for name, value, _, _ in fakes["mlflow"].metrics}
    for key in (
        "rollout/ep_rew_mean",
        "interventions/rate",
        "interventions/step_cost",
        "evaluation_filter_on/return",
    ):
        assert by_wandb[key] == by_mlflow[key], key
    assert [step for *_, step in fakes["mlflow"].metrics][-1] == fakes["wandb"].logged[-1]["timesteps"] == 128
    assert np.isfinite(list(by_mlflow.values())).all()
    first, second = fakes["wandb"].inits  # training and evaluation
    assert (
        first["project"] == "fake" and first["config"]["algorithm"] == "PPO" and first["config"]["seed"] == 0
    )
    assert first["id"] == second["id"] == json.loads((folder / "trackers.json").read_text())["Wandb"]
    assert fakes["wandb"].finished == 2
    assert fakes["mlflow"].runs == {"id 0": "FINISHED"} and fakes["mlflow"].params["total_steps"] == 128
    assert list(fakes["mlflow"].experiments) == ["fake"]


def test_nothing_that_is_no_finite_number_is_sent(fake_experiment, fakes, tmp_path):
    logger = run_logger(tracked(fake_experiment, "wandb"), 0, tmp_path / "a" / "b" / "seed_0")
    logger.record("a", float("nan"))
    logger.record("b", "text")
    logger.record("time/total", 3, exclude="tensorboard")
    logger.record("c", np.float32(0.5))
    logger.dump(7)
    logger.record("a", float("inf"))
    logger.dump(8)
    assert fakes["wandb"].logged == [{"c": 0.5, "timesteps": 7}]


def test_films_arrive_in_both(fake_experiment, fakes, tmp_path):
    folder = tmp_path / "a" / "b" / "seed_0"
    folder.mkdir(parents=True)
    path = film(tmp_path / "b_filter_on.webp")
    track_film(tracked(fake_experiment, "wandb", "mlflow"), 0, folder, "filter_on", path, 128)
    assert fakes["wandb"].logged == [{"films/filter_on": (5, "gif"), "timesteps": 128}]
    assert fakes["mlflow"].artifacts == [("films", str(path))]


def test_a_run_may_be_tracked_later_and_is_the_same_run(fake_experiment, fakes, tmp_path):
    folder = tmp_path / "fake" / "filtered" / "seed_0"
    train_run(tracked(fake_experiment), 0, folder, Reports().progress)
    assert not (folder / "trackers.json").exists() and not fakes["wandb"].inits
    train_run(tracked(fake_experiment, "wandb", steps=256), 0, folder, Reports().progress)
    assert len(fakes["wandb"].inits) == 1 and fakes["wandb"].logged[-1]["timesteps"] == 256


def test_a_tracker_that_refuses_is_told_and_one_that_is_lost_stops_no_training(
    fake_experiment, fakes, tmp_path
):
    arm, folder = tracked(fake_experiment, "wandb", "mlflow"), tmp_path / "fake" / "filtered" / "seed_0"

    def fail(*_, **__):
        raise OSError("no network")

    fakes["mlflow"].log_batch = fail
    with pytest.warns(UserWarning, match="Mlflow: what follows is not tracked: no network") as said:
        train_run(arm, 0, folder, Reports().progress)
    assert sum("Mlflow" in str(each.message) for each in said) == 1
    assert (folder / "finished.json").exists() and fakes["wandb"].logged
    fakes["wandb"].Video = fail
    with pytest.warns(UserWarning, match="Wandb: what follows is not tracked"):
        track_film(replace(arm, trackers=["wandb"]), 0, folder, "a", film(tmp_path / "a.webp"), 1)
    fakes["wandb"].init = fail
    with pytest.raises(
        RunStateError, match=r"Wandb does not take the run: no network\. .*WANDB_MODE=offline"
    ):
        run_logger(arm, 0, folder)


def test_what_is_not_installed_or_does_not_exist_is_refused(fake_experiment, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "wandb" else find(name, *a)
    )
    arm = tracked(fake_experiment, "wandb")
    with pytest.raises(
        ConfigurationError, match=r"filtered\.trackers: wandb .*pip install 'safe-wrappers\[wandb\]'"
    ):
        check_trackers(arm)
    with pytest.raises(ConfigurationError, match="wandb is not installed"):
        experiment_module.train_experiment(fake_experiment("trackers=[wandb]"), None)
    check_trackers(replace(arm, trackers=[]))
    with pytest.raises(UnknownNameError, match="Did you mean 'wandb'"):
        tracked(fake_experiment, "wand")


# The packages themselves, offline ----------------------------------------------------------------------------------


def test_wandb_takes_it_offline(fake_experiment, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    arm, folder = tracked(fake_experiment, "wandb"), tmp_path / "fake" / "filtered" / "seed_0"
    train_run(arm, 0, folder, Reports().progress)
    track_film(arm, 0, folder, "filter_on", film(tmp_path / "film.webp"), 128)
    runs = list((folder / "wandb").glob("offline-run-*"))
    assert len(runs) == 2 and all(list(run.glob("*.wandb")) for run in runs)


def test_mlflow_takes_it_in_a_folder(fake_experiment, tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "mlruns").as_uri())
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    arm, folder = tracked(fake_experiment, "mlflow"), tmp_path / "fake" / "filtered" / "seed_0"
    train_run(arm, 0, folder, Reports().progress)
    track_film(arm, 0, folder, "filter_on", film(tmp_path / "film.webp"), 128)
    client = mlflow.MlflowClient()
    run = client.get_run(json.loads((folder / "trackers.json").read_text())["Mlflow"])
    assert "interventions/rate" in run.data.metrics and run.data.params["algorithm"] == "PPO"
    assert [each.path for each in client.list_artifacts(run.info.run_id, "films")] == ["films/film.webp"]
