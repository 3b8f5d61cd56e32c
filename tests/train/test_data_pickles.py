"""Checkpoints and SB3 files that would run something: it is not run, by no way in which they are read."""

import base64
import json
import pickle
import zipfile
from pathlib import Path

import pytest
from rich.console import Console
from test_run import Reports

from safe_wrappers import info as keys
from safe_wrappers.errors import RunStateError
from safe_wrappers.train.acting import enjoy_command
from safe_wrappers.train.policies import load_policy
from safe_wrappers.train.run.checkpoint import resume
from safe_wrappers.train.run.data_pickles import read_pickle
from safe_wrappers.train.run.stack import make_vec_env
from safe_wrappers.train.run.training import train_run


class Touch:
    """Unpickled, it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


SAC = (
    "algorithm=SAC",
    "hyperparameters={learning_starts: 16, batch_size: 8, policy_kwargs: {net_arch: [8]}}",
    *("seeds=[0]", "normalize={observation: true}"),
)


@pytest.fixture
def run(fake_experiment):
    """Arm and folder of a finished run, and its checkpoint's."""
    experiment = fake_experiment(*SAC, "total_steps=32")
    arm = experiment.arms[0]
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, Reports().progress)
    (checkpoint,) = (folder / "checkpoints").iterdir()
    return arm, folder, checkpoint


def poison(checkpoint, name, payload):
    """The payload inside of a checkpoint's file."""
    path = checkpoint / name
    if name == "model.zip":
        with zipfile.ZipFile(path) as archive:
            parts = {part: archive.read(part) for part in archive.namelist()}
        data = json.loads(parts["data"])
        data["lr_schedule"][":serialized:"] = base64.b64encode(pickle.dumps(payload)).decode()
        parts["data"] = json.dumps(data)
        with zipfile.ZipFile(path, "w") as archive:
            for part, content in parts.items():
                archive.writestr(part, content)
    else:
        path.write_bytes(pickle.dumps(payload))


@pytest.mark.parametrize("name", ["model.zip", "vecnormalize.pkl"])
def test_a_policy_that_would_run_something_is_refused(run, fake_experiment, tmp_path, name):
    _, folder, checkpoint = run
    poison(checkpoint, name, Touch(tmp_path / "made"))
    longer = fake_experiment(*SAC, "total_steps=64").arms[0]  # the run would go on
    for use in (
        lambda: load_policy(folder),
        lambda: enjoy_command(str(folder), 1, "trained", False, None, Console(quiet=True)),
        lambda: train_run(longer, 0, folder, Reports().progress),
    ):
        with pytest.raises(RunStateError, match=rf"{name}' is refused: its pickle names pathlib\.Path"):
            use()
    assert not (tmp_path / "made").exists()
    pickle.loads(pickle.dumps(Touch(tmp_path / "made")))
    assert (tmp_path / "made").exists()  # it would have been


def test_a_replay_buffer_that_would_run_something_is_refused(run, tmp_path):
    arm, _, checkpoint = run
    poison(checkpoint, "replay_buffer.pkl", Touch(tmp_path / "made"))
    with pytest.raises(RunStateError, match=r"replay_buffer\.pkl' is refused"):
        resume(checkpoint, "SAC", make_vec_env(arm), "cpu", 100)
    assert not (tmp_path / "made").exists()


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
