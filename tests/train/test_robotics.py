"""Envs of gymnasium-robotics in a config, which nobody has registered and whose observations are dicts."""

import json
import subprocess
import sys

import pytest

from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model

SILENT = Progress(lambda _: None, lambda _: None)


def test_fetch_reach_is_trained_and_evaluated_by_its_plain_id(fake_experiment):
    pytest.importorskip("gymnasium_robotics")
    experiment = fake_experiment(
        "env=FetchReach-v4",
        "arms={filtered: {filter: {protect: {}}}}",
        "hyperparameters={n_steps: 100, batch_size: 50, n_epochs: 1}",
        "total_steps=200",
        "evaluation.episodes=1",
    )
    (arm,) = experiment.arms
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, SILENT)
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 200
    evaluate_run(arm, 0, folder, experiment.evaluation, arm.filter, SILENT)
    (row,) = read_rows(folder / "evaluation" / "filter_on.csv")
    assert row["length"] == 50
    model = load_model(latest_checkpoint(folder / "checkpoints").folder, "PPO", "cpu")
    assert type(model.policy).__name__ == "MultiInputActorCriticPolicy"


def test_a_new_process_registers_them_when_asked():
    pytest.importorskip("gymnasium_robotics")
    code = (
        "import gymnasium as gym; from safe_wrappers.train.config import check_env_id;"
        "assert 'FetchReach-v4' not in gym.registry; check_env_id('FetchReach-v4');"
        "assert 'FetchReach-v4' in gym.registry"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
