"""Checkpoints: whole whatever kills the process, and read without running what a pickle in them says."""

import base64
import json
import os
import pickle
import shutil
import signal
import sys
import zipfile
from pathlib import Path

import fake_task
import numpy as np
import pytest
import torch
from running import resumed, trained
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from safe_wrappers import info as keys
from safe_wrappers.errors import RunStateError
from safe_wrappers.train.config.algorithms import algorithm_class
from safe_wrappers.train.policies import load_policy
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model, resume, save_checkpoint
from safe_wrappers.train.run.data_pickles import read_pickle
from safe_wrappers.train.run.model_files import write_model


@pytest.mark.parametrize(
    "algorithm", ["SAC", "PPO", "sbx.SAC", pytest.param("sbx.PPO", marks=pytest.mark.slow)]
)
def test_a_model_that_was_stored_learns_on_as_if_it_were_not(tmp_path, algorithm):
    if algorithm.startswith("sbx."):
        pytest.importorskip("sbx")
    env, small = DummyVecEnv([fake_task.FakeGoal]), {"policy_kwargs": {"net_arch": [4]}, "batch_size": 8}
    small |= {"n_steps": 16} if algorithm.endswith("PPO") else {"learning_starts": 8, "buffer_size": 64}
    model = algorithm_class(algorithm)("MlpPolicy", env, seed=0, device="cpu", **small)
    model.learn(32)
    folder = save_checkpoint(tmp_path, model, {})
    before = model.predict(np.zeros(2))[0]

    def learned(each):
        env.seed(1)
        each._last_obs = None  # a run that goes on begins new episodes
        each.learn(16, reset_num_timesteps=False)
        return each.predict(np.zeros(2))[0]  # drawn: the keys of random numbers count, too

    expected = learned(model)
    again = resume(folder, algorithm, env, "cpu", 64)
    np.testing.assert_array_equal(again.predict(np.zeros(2))[0], before)
    np.testing.assert_array_equal(learned(again), expected)


# SIGKILL at every file operation: there is a whole one afterwards, no older one than before -----------------------

OPERATIONS = ("open", "os.", "shutil.")
"""Audit events of the interpreter: each file operation is announced before it is made."""


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    small = {"buffer_size": 8, "policy_kwargs": {"net_arch": [2]}}
    return SAC("MlpPolicy", fake_task.FakeGoal(), device="cpu", **small)


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


@pytest.mark.parametrize(("before", "final"), [((), False), ((64, 128), True)])
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


# Pickles that would run something: it is not run, by no way in which they are read --------------------------------


class Touch:
    """Unpickled, it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def rewrite(path, name, change):
    """Another content of one part of a zip file."""
    with zipfile.ZipFile(path) as archive:
        parts = {part: archive.read(part) for part in archive.namelist()}
    parts[name] = change(parts[name])
    with zipfile.ZipFile(path, "w") as archive:
        for part, content in parts.items():
            archive.writestr(part, content)


@pytest.mark.parametrize("name", ["model.zip", "vecnormalize.pkl", "replay_buffer.pkl"])
def test_a_checkpoint_that_would_run_something_is_refused(finished, fake_experiment, tmp_path, name):
    experiment, longer = finished(), finished("total_steps=640")  # the run would go on
    folder = experiment.run_folder(experiment.arms[1], 0)
    uses = [lambda: load_policy(folder), lambda: trained(longer)]
    if name == "replay_buffer.pkl":
        learner = "hyperparameters={learning_starts: 16, batch_size: 8, policy_kwargs: {net_arch: [8]}}"
        sac = fake_experiment("name=sac", "algorithm=SAC", learner, "total_steps=32")
        folder = trained(sac)
        uses = [lambda: resumed(sac.arms[1], folder)]
    (checkpoint,) = (folder / "checkpoints").iterdir()
    poison = pickle.dumps(Touch(tmp_path / "made"))

    def poisoned(content):
        data = json.loads(content)
        data["lr_schedule"][":serialized:"] = base64.b64encode(poison).decode()
        return json.dumps(data)

    if name == "model.zip":
        rewrite(checkpoint / name, "data", poisoned)
    else:
        (checkpoint / name).write_bytes(poison)
    for use in uses:
        with pytest.raises(RunStateError, match=rf"{name}' is refused: its pickle names pathlib\.Path"):
            use()
    assert not (tmp_path / "made").exists()
    pickle.loads(poison)
    assert (tmp_path / "made").exists()  # it would have been


def test_arrays_of_no_such_network_are_refused(tmp_path):
    sbx = pytest.importorskip("sbx")
    write_model(sbx.SAC("MlpPolicy", fake_task.FakeGoal(), buffer_size=1), tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"Policy \(its arrays are .*load_policy\) unknown"):
        sbx.SAC.load(tmp_path / "model.zip")
    for content in (b"", b"\x80", b"\x82\xa5model\x80\xa6policy\x80"):
        rewrite(tmp_path / "model.zip", "jax.msgpack", lambda _, content=content: content)
        with pytest.raises(RunStateError, match=r"model\.zip' cannot be read"):
            load_model(tmp_path, "sbx.SAC", "cpu")


@pytest.mark.parametrize(
    "text",
    [
        b"cposix\nsystem\n.",
        b"cbuiltins\neval\n.",
        b"cnumpy\nf2py.os.system\n.",
        b"\x80\x04\x8c\x05torch\x8c\x17serialization.os.system\x93.",
        b"cstable_baselines3.common.save_util\nload_from_pkl\n.",
        b"cstable_baselines3.common.monitor\nResultsWriter\n.",
        b"csafe_wrappers.train.run.checkpoint\nshutil\n.",
        b"cnumpy\nload\n.",
        b"ctorch.storage\n_load_from_bytes\n.",
        b"cantigravity\nfly\n.",
    ],
    ids=str,
)
def test_only_data_is_found(tmp_path, text):
    (tmp_path / "x.pkl").write_bytes(text)
    with pytest.raises(RunStateError, match=r"x\.pkl' is refused: its pickle names"):
        read_pickle(tmp_path / "x.pkl")


def test_what_nobody_judged_is_found(tmp_path):
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(keys.NOT_JUDGED))
    assert read_pickle(tmp_path / "x.pkl") is keys.NOT_JUDGED
