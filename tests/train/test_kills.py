"""SIGKILL at every file operation of a checkpoint: there is a whole one afterwards, no older one than before."""

import os
import shutil
import signal
import sys

import fake_task
import pytest
import torch
from stable_baselines3 import SAC

from safe_wrappers.train.files import only_writer
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model, save_checkpoint

OPERATIONS = ("open", "os.", "shutil.")
"""Audit events of the interpreter: each file operation is announced before it is made."""


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return SAC(
        "MlpPolicy", fake_task.FakeGoal(), buffer_size=8, policy_kwargs={"net_arch": [2]}, device="cpu"
    )


def save(model, root, step, final=False):
    model.num_timesteps = step
    save_checkpoint(root, model, {"timesteps": step, "elapsed_s": 1.0}, final)


def killed_at(operation, root, work):
    """Does work in a forked process, and whether it was killed before its end."""
    child = os.fork()
    if child:
        return os.WIFSIGNALED(os.waitpid(child, 0)[1])
    left = operation

    def kill(event, arguments):
        nonlocal left
        if event.startswith(OPERATIONS) and any(str(root) in str(argument) for argument in arguments):
            left -= 1
            if left < 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(kill)
    work()
    os._exit(0)


def reached(root):
    found = latest_checkpoint(root)
    if found is None:
        return 0
    assert load_model(found.folder, "SAC", "cpu").num_timesteps == found.timesteps
    return found.timesteps


@pytest.mark.parametrize(
    ("before", "final"), [((), False), ((64,), False), ((64, 128), False), ((64, 128), True)]
)
def test_a_kill_at_any_file_operation_loses_no_checkpoint(tmp_path, model, before, final):
    whole, step = tmp_path / "whole", 192
    whole.mkdir()
    for each in before:
        save(model, whole / "checkpoints", each)
    for operation in range(1000):
        run = tmp_path / "run"
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(whole, run)
        root = run / "checkpoints"
        killed = killed_at(operation, root, lambda root=root: save(model, root, step, final))
        first = reached(root)
        assert first in {max(before, default=0), step}
        if killed and operation % 7 == 3:  # the same command goes on, and is killed, too
            killed_at(operation, root, lambda root=root: save(model, root, step, final))
            assert first <= reached(root)
        save(model, root, step, final)
        names = sorted(path.name for path in root.iterdir())
        kept = sorted({*(() if final else before), step})[-2:]
        assert names == [f"step_{each:012d}" for each in kept]
        if not killed:
            break
    assert operation > 10


def test_a_killed_process_holds_no_folder(tmp_path):
    hold = only_writer(tmp_path)
    child = os.fork()
    if not child:
        hold.__enter__()
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    with only_writer(tmp_path):
        pass
