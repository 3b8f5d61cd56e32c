"""Runs on a Ray cluster of two nodes on this machine: as on one machine, and with a node that is lost."""

import io
import json
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console
from stable_baselines3.common.save_util import load_from_zip_file

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import read_config
from safe_wrappers.train.experiment import evaluate_experiment, train_experiment
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.processes import Job
from safe_wrappers.train.processes.parallel import RunsFailedError, run_jobs
from safe_wrappers.train.sweep import sweep_experiment

ray = pytest.importorskip("ray", reason="ray is not installed: pip install 'safe-wrappers[ray]'")
FAKE = "tests/train/fake.yaml"


@pytest.fixture
def cluster():
    """A head that runs no tasks, and two nodes of one CPU."""
    from ray.cluster_utils import Cluster

    memory = 100 * 1024**2
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": memory})
    try:
        nodes = [made.add_node(num_cpus=1, object_store_memory=memory) for _ in range(2)]
        ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
        made.wait_for_nodes()
        yield made, nodes
    finally:
        ray.shutdown()
        made.shutdown()


def console():
    return Console(file=io.StringIO(), width=100)


def learned(experiment):
    """All that was learned and what it came to, of every run."""
    found = {}
    for arm in experiment.arms:
        for seed in experiment.seeds:
            folder = experiment.run_folder(arm, seed)
            found[arm.name, seed] = (
                load_from_zip_file(folder / "policy" / "model.zip")[1]["policy"][
                    "action_net.weight"
                ].tolist(),
                (folder / "episodes.csv").read_text(),
                (folder / "evaluation" / "filter_on.csv").read_text(),
            )
    return found


@pytest.mark.slow
def test_a_cluster_learns_what_one_machine_learns_bit_for_bit(cluster, fake_experiment, tmp_path):
    there = fake_experiment("seeds=[0]", "workers=2", f"output={tmp_path}/there")
    here = fake_experiment("seeds=[0]", "workers=2", f"output={tmp_path}/here")
    for experiment, on in ((there, "ray"), (here, None)):
        train_experiment(experiment, console(), on)
        evaluate_experiment(experiment, console(), on)
    assert learned(there) == learned(here)


@pytest.mark.slow
def test_a_node_is_lost_and_its_run_goes_on_from_its_checkpoint_elsewhere(cluster, fake_experiment):
    made, nodes = cluster
    experiment = fake_experiment("total_steps=8192", "checkpoint_every=256", "seeds=[0]")
    folders = [experiment.run_folder(arm, 0) for arm in experiment.arms]
    kept = {}

    def lose_a_node():
        end = time.monotonic() + 240.0
        while not all(list(folder.glob("checkpoints/step_*/state.json")) for folder in folders):
            if time.monotonic() > end:
                return  # nothing is kept: the test fails
            time.sleep(0.1)
        for folder in folders:
            at = max(int(path.name[5:]) for path in folder.glob("checkpoints/step_*"))
            kept[folder] = [row for row in read_rows(folder / "episodes.csv") if row["timesteps"] <= at]
        made.remove_node(nodes[0], allow_graceful=False)

    loses = threading.Thread(target=lose_a_node, daemon=True)
    loses.start()
    train_experiment(experiment, console(), "ray")
    loses.join()
    assert set(kept) == set(folders)
    for folder in folders:
        assert json.loads((folder / "finished.json").read_text())["timesteps"] == 8192
        rows = read_rows(folder / "episodes.csv")
        assert kept[folder] and rows[: len(kept[folder])] == kept[folder]  # nothing done is done again
        steps = [row["timesteps"] for row in rows]
        assert steps == sorted(steps)
        assert sum(row["length"] for row in rows) <= 8192


def test_failures_and_messages_come_back(cluster):
    import fake_task

    jobs = [Job("good", 100, "steps", fake_task.count, (10,)), Job("bad", 100, "steps", fake_task.fail, ())]
    told = console()
    with pytest.raises(RunsFailedError, match="bad: too hot"):
        run_jobs(jobs, 2, told, "Counting", on="ray")
    assert "good: a line to read" in told.file.getvalue()
    assert "good: done" in told.file.getvalue()


@pytest.mark.slow
def test_a_sweep_tries_on_a_cluster_what_it_tries_here(cluster, tmp_path):
    pytest.importorskip("optuna", reason="optuna is not installed: pip install 'safe-wrappers[sweep]'")
    overrides = ["total_steps=128", "seeds=[0]", "evaluation.episodes=1", "workers=2"]
    rate = {"hyperparameters.learning_rate": {"low": 1e-5, "high": 1e-2, "log": True}}
    searched = {
        **read_config(Path(FAKE), overrides),
        "sweep": {"parameters": rate, "trials": 4, "at_once": 2},
    }
    tables = []
    for name, on in (("there", "ray"), ("here", None)):
        sweep_experiment({**searched, "output": str(tmp_path / name)}, Path(FAKE), (), console(), on)
        tables.append((tmp_path / name / "fake" / "sweep" / "sweep.csv").read_text())
    assert tables[0] == tables[1] and tables[0].count("at cost zero") == 4


@pytest.mark.parametrize("on", ["slurm", "ray:", "rays"])
def test_other_places_are_refused(on, capsys):
    assert main(["train", FAKE, "--on", on]) == 1
    assert "--on: expected ray or ray:ADDRESS" in capsys.readouterr().err


def test_without_ray_it_says_what_to_install(monkeypatch):
    import importlib.util

    from safe_wrappers.train.processes.on_ray import check_place

    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match=r"pip install 'safe-wrappers\[ray\]'"):
        check_place("ray")
