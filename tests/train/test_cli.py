"""The command as a person runs it: a real process, spawned workers, kills, and what it prints."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from safe_wrappers.train.cli import main
from safe_wrappers.train.files import read_rows

FAKE = Path(__file__).parent / "fake.yaml"
FILTERED = "arms={filtered: {filter: {factory: 'fake_task:shield'}}}"
COMMAND = [sys.executable, "-m", "safe_wrappers.train.cli"]


def heed_interrupts():
    """Tests that are started in a shell's background ignore SIGINT, and so would their children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture
def start():
    """Starts the command; what a failing test leaves running is killed."""
    started = []

    def run(command, *overrides, before=()):
        process = subprocess.Popen(
            [*before, *COMMAND, command, str(FAKE), *overrides],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=None if before else heed_interrupts,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.wait()


def wait_for(condition, seconds=240.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_compare_from_nothing_to_the_report_in_parallel_processes(tmp_path, start):
    process = start("compare", f"output={tmp_path}", "seeds=[0]", "workers=2", "--report")
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    assert "training filtered seed 0: done" in out
    assert "evaluation unfiltered seed 0: done" in out
    assert "fake: one seed, no interval" in " ".join(out.split())
    assert (
        "one seed says little" in " ".join(out.split()) and "With the filter" in out
    )  # the verdict, after the table
    sections = ("Training, all episodes", "Evaluation, filter off", "Evaluation, filter on", "Cost / episode")
    for text in sections:
        assert text in out
    report = tmp_path / "fake" / "report.html"
    assert f"Report: {report}" in out
    assert report.exists()
    for arm in ("unfiltered", "filtered"):
        folder = tmp_path / "fake" / arm / "seed_0"
        assert json.loads((folder / "finished.json").read_text())["timesteps"] == 512
        assert len(read_rows(folder / "evaluation" / "filter_on.csv")) == 3
    assert (tmp_path / "fake" / "per_seed.csv").read_text().count("\n") == 1 + 2 * 3


@pytest.mark.slow
def test_a_stopped_or_killed_comparison_leaves_no_process_behind_and_goes_on(tmp_path, start):
    overrides = [f"output={tmp_path}", "total_steps=24000", "seeds=[0]", FILTERED]
    folder = tmp_path / "fake" / "filtered" / "seed_0"
    process = start("train", *overrides, "checkpoint_every=1000000")
    wait_for(lambda: len(read_rows(folder / "episodes.csv")) > 20)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert process.returncode == 130
    assert err == "Stopped. The same command goes on.\n"
    (checkpoint,) = (folder / "checkpoints").iterdir()
    at = int(checkpoint.name.removeprefix("step_"))
    assert f"training filtered seed 0: stopped; goes on from step {at:,}" in out
    assert not _held(folder / ".lock")
    overrides.append("checkpoint_every=1000")
    process = start("train", *overrides)
    wait_for(lambda: len(list(folder.glob("checkpoints/step_*/state.json"))) >= 2)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    # The workers notice and end: the rows stop growing, and the folder is free again.
    wait_for(lambda: not _held(folder / ".lock"))
    at = max(int(path.name[5:]) for path in (folder / "checkpoints").glob("step_*"))
    assert 1000 <= at < 24000
    early = [row for row in read_rows(folder / "episodes.csv") if row["timesteps"] <= at]
    assert not (folder / "finished.json").exists()
    out, err = start("train", *overrides).communicate(timeout=600)
    assert "training filtered seed 0: done" in out, err
    rows = read_rows(folder / "episodes.csv")
    assert rows[: len(early)] == early
    steps = [row["timesteps"] for row in rows]
    assert steps == sorted(steps)
    assert sum(row["length"] for row in rows) <= 24_064  # nothing counted twice; whole rollouts
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 24_064


def test_help_and_mistakes_in_the_command_do_not_wait_for_torch():
    # Not yaml: numba reads its own settings with it.
    code = """
import sys
from safe_wrappers.train.cli import main
late = {"torch", "stable_baselines3", "sb3_contrib", "tensorboard", "matplotlib", "PIL", "gymnasium_robotics"}
late |= {"optuna", "ray"}
for arguments in (["--help"], ["--version"], ["trian"], ["train"], ["train", "a.yaml", "--no"], ["train", "a.yaml"]):
    read = {"rich", "pydantic"} if arguments != ["train", "a.yaml"] else set()
    try:
        main(arguments)
    except SystemExit:
        pass
    loaded = (late | read) & set(sys.modules)
    assert not loaded, (arguments, loaded)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd="/")
    assert done.returncode == 0, done.stderr
    assert "There is no config file 'a.yaml'" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "a.yaml", "--report"], "unrecognized arguments: --report"),
        (["train", "a.yaml", "--no"], "unrecognized arguments: --no"),
        (["train", "n_envs=1"], "the following arguments are required: CONFIG.yaml"),
    ],
)
def test_options_of_another_command_are_refused(words, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2 and message in capsys.readouterr().err


def test_a_factory_is_found_beside_the_config(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "own_filters.py").write_text("from fake_task import shield\n")
    (folder / "config.yaml").write_text(FAKE.read_text())
    monkeypatch.setattr(sys, "path", [*sys.path])
    arms = "arms={filtered: {filter: {factory: 'own_filters:shield'}}}"
    assert main(["train", str(folder / "config.yaml"), f"output={tmp_path}", "seeds=[0]", arms]) == 0
    assert json.loads((tmp_path / "fake" / "filtered" / "seed_0" / "finished.json").read_text())
    arms = "arms={other: {filter: {factory: 'nowhere:shield'}}}"
    assert main(["train", str(folder / "config.yaml"), f"output={tmp_path}", "seeds=[0]", arms]) == 1
    err = capsys.readouterr().err
    assert "filter.factory: cannot import 'nowhere:shield'" in err


def test_errors_are_lines_and_not_tracebacks(tmp_path, capsys):
    assert main(["train", str(FAKE), f"output={tmp_path}", "total_step=3"]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith("error: config: unknown name 'total_step'. Did you mean 'total_steps'?")
    assert main(["report", str(FAKE), f"output={tmp_path}"]) == 1
    assert "yet; run `safe-wrappers compare` first." in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["trian", str(FAKE)])
    assert "invalid choice: 'trian'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            [FILTERED, "arms.filtered.filter.kwargs.no_such=1"],
            "filter.kwargs: shield() got an unexpected keyword",
        ),
        (
            ["env={id: Pendulum-v1, kwargs: {no_such: 1}}"],
            "env: Pendulum-v1 with kwargs {'no_such': 1} cannot",
        ),
        (["arms.filtered.filter=protect"], "no recipe for"),
        (["env=Reachr-v5"], "Reachr-v5"),
        (["arms.filtered.filter={factory: 'nowhere:shield'}"], "cannot import 'nowhere:shield'"),
        (["total_steps=-1"], "total_steps"),
    ],
)
def test_arms_that_cannot_be_made_are_refused_before_anything_starts(tmp_path, capsys, overrides, message):
    assert main(["train", str(FAKE), f"output={tmp_path}", "seeds=[0]", *overrides]) == 1
    captured = capsys.readouterr()
    assert "\nerror: " in "\n" + captured.err  # after what other packages say when they are imported
    assert message in captured.err
    assert "started" not in captured.out
    assert not list(tmp_path.iterdir())  # nothing that the corrected command could stumble over


def _held(path):
    import fcntl

    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
