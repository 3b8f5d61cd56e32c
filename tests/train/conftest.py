import os
import shutil
from pathlib import Path

import pytest
import torch
from fake_task import FILMED
from running import evaluated, trained

from safe_wrappers.train.config import parse_experiment, read_config

# JAX compiles for most of the time that a test with sbx takes.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)
torch.set_num_threads(1)  # as in the workers; two threads on two busy cores only wait for each other

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def fake_task_importable(monkeypatch):
    """Spawned processes find `fake_task` too; the real command by itself, because it lies beside the config."""
    monkeypatch.syspath_prepend(str(HERE))


def parsed(folder, *overrides):
    return parse_experiment(read_config(HERE / "fake.yaml", [f"output={folder}", *overrides]))


@pytest.fixture
def fake_experiment(tmp_path):
    """The fake experiment in a folder of its own, with overrides."""
    return lambda *overrides: parsed(tmp_path, *overrides)


@pytest.fixture(scope="session")
def kept(tmp_path_factory):
    """The shared experiment, two arms and two seeds, trained and evaluated once for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HERE))
        experiment = parsed(tmp_path_factory.mktemp("kept"), *FILMED)
        for arm in (0, 1):
            for seed in experiment.seeds:
                trained(experiment, arm, seed)
                evaluated(experiment, arm, seed)
    return experiment


@pytest.fixture
def finished(kept, fake_experiment):
    """A copy of the shared experiment, to change; with overrides where its runs are another experiment's."""

    def make(*overrides):
        experiment = fake_experiment(*FILMED, *overrides)
        if not experiment.folder.exists():
            shutil.copytree(kept.folder, experiment.folder)
        return experiment

    return make
