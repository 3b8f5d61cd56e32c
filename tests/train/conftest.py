from pathlib import Path

import pytest
import torch

from safe_wrappers.train.config import parse_experiment, read_config

torch.set_num_threads(1)  # as in the workers; two threads on two busy cores only wait for each other

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def fake_task_importable(monkeypatch):
    """Spawned processes find `fake_task` too; the real command by itself, because it lies beside the config."""
    monkeypatch.syspath_prepend(str(HERE))


@pytest.fixture
def fake_experiment(tmp_path):
    """The fake experiment in a folder of its own, with overrides."""

    def make(*overrides):
        return parse_experiment(read_config(HERE / "fake.yaml", [f"output={tmp_path}", *overrides]))

    return make
