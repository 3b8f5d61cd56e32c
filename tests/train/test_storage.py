"""Disks that are full or cannot be written to, folders that others hold, clocks that jump."""

import errno
import fcntl
import os
import resource
import socket
import time
from pathlib import Path

import pytest
from rich.console import Console
from stable_baselines3 import PPO

from safe_wrappers.errors import RunStateError
from safe_wrappers.train import cli
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.experiment import evaluate_experiment, train_experiment
from safe_wrappers.train.processes import lock
from safe_wrappers.train.processes.job import Progress
from safe_wrappers.train.processes.lock import FolderHeldError, only_writer
from safe_wrappers.train.processes.storage import telling_of_storage
from safe_wrappers.train.run import train_run
from safe_wrappers.train.run.checkpoint import latest_checkpoint
from safe_wrappers.train.files import read_rows

QUIET = Progress(lambda _: None, lambda _: None)
SAC = (
    "algorithm=SAC",
    "hyperparameters={learning_starts: 50, batch_size: 16, buffer_size: 4000}",
    "n_envs=1",
)


def train(experiment, arm=1):
    folder = experiment.run_folder(experiment.arms[arm], 0)
    train_run(experiment.arms[arm], 0, folder, QUIET)
    return folder


def sizes(folder):
    return sorted({path.stat().st_size for path in folder.rglob("*") if path.is_file()})


def test_every_file_that_cannot_be_written_is_told_and_the_last_checkpoint_stays(fake_experiment, tmp_path):
    """The kernel refuses to write more than so many bytes: once for each size that a file of the run has."""
    folder = train(fake_experiment(*SAC, "total_steps=128"))
    at = folder / "checkpoints" / "step_000000000128"
    longer = fake_experiment(*SAC, "total_steps=256", "checkpoint_every=64")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    told = set()
    for size in sizes(at):
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))
            with pytest.raises(RunStateError, match="larger than this process may write") as refusal:
                train(longer)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        told.add(str(refusal.value))
        assert "the same command goes on" in str(refusal.value) and "bytes are free" in str(refusal.value)
        assert latest_checkpoint(folder / "checkpoints", pytest.fail).timesteps == 128
        assert not (folder / "checkpoints" / ".writing").exists()  # what it took is free again
        assert not list(folder.rglob(".*.tmp"))
    assert len(told) > 1
    train(longer)
    assert latest_checkpoint(folder / "checkpoints", pytest.fail).timesteps == 256


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "no space is left on the disk"),
        (errno.EDQUOT, "the quota"),
        (errno.EROFS, "read-only"),
        (errno.EACCES, "no permission"),
        (errno.EIO, "the disk fails"),
        (errno.ESTALE, "the network disk has gone"),
    ],
)
def test_what_a_disk_refuses_is_a_line_also_where_torch_has_made_another_error_of_it(tmp_path, number, words):
    def refuse():
        try:
            raise OSError(number, os.strerror(number))
        except OSError:
            raise RuntimeError("PytorchStreamWriter failed writing file")  # noqa: B904

    with pytest.raises(RunStateError, match=words) as refusal, telling_of_storage(tmp_path):
        refuse()
    assert str(tmp_path) in str(refusal.value)
    with pytest.raises(FileNotFoundError), telling_of_storage(tmp_path):
        (tmp_path / "nothing").read_bytes()


def test_a_full_disk_is_one_line_of_the_command_too(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "summary.json"))

    monkeypatch.setattr(cli, "_run", full)
    assert cli.main(["report", "a.yaml"]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"error: '{tmp_path / 'summary.json'}': no space is left on the disk (")


@pytest.mark.parametrize("command", [train_experiment, evaluate_experiment])
def test_a_folder_that_cannot_be_written_to_is_refused_at_the_start(
    fake_experiment, tmp_path, monkeypatch, command
):
    experiment = fake_experiment("seeds=[0]")
    if command is evaluate_experiment:
        for arm in (0, 1):
            train(experiment, arm)
    there = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    with pytest.raises(RunStateError, match=r"cannot be written to .* choose another `output`"):
        command(experiment, Console(quiet=True))
    assert sorted(tmp_path.rglob("*")) == there


def test_a_file_where_a_folder_should_be_is_refused(fake_experiment, tmp_path):
    (tmp_path / "fake").write_text("")
    with pytest.raises(RunStateError, match="is a file where a folder is needed"):
        train_experiment(fake_experiment(), Console(quiet=True))


@pytest.mark.parametrize("command", [train_experiment, evaluate_experiment])
def test_the_second_command_on_a_folder_is_refused_at_the_start_and_told_who_has_it(
    fake_experiment, monkeypatch, command
):
    monkeypatch.setattr(lock, "_PATIENCE_S", 0.0)
    experiment = fake_experiment("seeds=[0]")
    for arm in (0, 1):
        train(experiment, arm)
    folder = experiment.run_folder(experiment.arms[1], 0)
    who = f"(process {os.getpid()} on {socket.gethostname()}); wait for it, or end it first"
    with only_writer(folder):
        for refused in (
            lambda: command(experiment, Console(quiet=True)),
            lambda: train(experiment),
            lambda: evaluate_run(
                experiment.arms[1], 0, folder, experiment.evaluation, experiment.evaluation_filter, QUIET
            ),
        ):
            with pytest.raises(FolderHeldError) as refusal:
                refused()
            assert who in str(refusal.value)
    train(experiment)


def test_a_lock_that_is_let_go_within_a_second_is_waited_for(tmp_path, monkeypatch):
    attempts = []

    def flock(*_):
        attempts.append(1)
        if len(attempts) < 3:
            raise BlockingIOError

    monkeypatch.setattr(fcntl, "flock", flock)
    with only_writer(tmp_path):
        assert len(attempts) == 3


def test_a_file_system_without_locks_is_refused(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with (
        pytest.raises(RunStateError, match=r"cannot lock files .* choose an `output` on a disk"),
        only_writer(tmp_path),
    ):
        pass


def test_a_wall_clock_that_jumps_changes_nothing(fake_experiment, monkeypatch):
    expected = train(fake_experiment("name=steady"))
    jumps = iter([0, -(10**9), 10**8, -(10**7)] * 10**6)
    now, now_ns = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: now() + next(jumps))
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + 10**9 * next(jumps))
    found = train(fake_experiment("name=jumping"))
    assert next(jumps) is not None
    assert read_rows(found / "episodes.csv") == read_rows(expected / "episodes.csv")
    assert (found / "policy" / "model.npz").read_bytes() == (expected / "policy" / "model.npz").read_bytes()
    facts = latest_checkpoint(found / "checkpoints", pytest.fail)
    assert 0 < facts.elapsed_s < 600


def test_a_setting_that_the_first_update_finds_wrong_does_not_block_the_corrected_command(
    fake_experiment, monkeypatch
):
    update = PPO.train

    def refusing(self):
        if self.gamma == 0.5:
            raise ValueError("no such gamma")
        update(self)

    monkeypatch.setattr(PPO, "train", refusing)
    wrong = fake_experiment("hyperparameters.gamma=0.5")
    with pytest.raises(ValueError, match="no such gamma"):
        train(wrong)
    folder = wrong.run_folder(wrong.arms[1], 0)
    left = {path.name for path in folder.iterdir()}
    assert {"run.json", "episodes.csv", "tensorboard"} <= left
    (folder / "trackers.json").write_text("{}")
    corrected = fake_experiment("name=fresh")
    expected = train(corrected)
    assert train(fake_experiment()) == folder
    assert len(list((folder / "tensorboard").iterdir())) == 1  # not the curve of the other setting
    assert not (folder / "trackers.json").exists()
    for name in ("episodes.csv", "run.json"):
        assert (folder / name).read_bytes() == (expected / name).read_bytes()


def test_temporary_files_of_killed_processes_go_and_those_of_live_ones_stay(tmp_path):
    from safe_wrappers.train.files import write_text

    def temporary(pid, host):
        path = Path(tmp_path / f".a[1].csv.{host}.{pid}.tmp")
        path.write_text("half")
        return path

    child = os.fork()
    if not child:
        os._exit(0)
    os.waitpid(child, 0)
    here = socket.gethostname()
    dead, live, elsewhere = temporary(child, here), temporary(os.getppid(), here), temporary(child, "another")
    write_text(tmp_path / "a[1].csv", "whole")
    assert (tmp_path / "a[1].csv").read_text() == "whole"
    assert not dead.exists() and live.exists() and elsewhere.exists()
