"""The command as a person runs it: a real process, spawned workers, kills, and what each of its words does."""

import io
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from filelock import FileLock, Timeout
from PIL import Image
from running import episodes, finish, trained

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.acting import of_run
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import parse_experiment, read_config
from safe_wrappers.train.config.algorithms import ALGORITHMS
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.videos import HEIGHT, STRIP, WIDTH
from safe_wrappers.wrappers.recipes import EVERY, recipe_of

FAKE = Path(__file__).parent / "fake.yaml"
FILTERED = "arms={filtered: {filter: {factory: 'fake_task:shield'}}}"


@pytest.fixture
def start():
    """Starts the command; what a failing test leaves running is killed."""
    started = []

    def run(command, *overrides):
        process = subprocess.Popen(
            [sys.executable, "-m", "safe_wrappers.train.cli", command, str(FAKE), *overrides],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # In a shell's background tests ignore SIGINT, and so would their children.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.wait()


def held(path):
    try:
        with FileLock(path).acquire(timeout=0):
            return False
    except Timeout:
        return True


def wait_for(condition, seconds=240.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_compare_from_nothing_to_the_report_in_processes_of_their_own(tmp_path, start):
    """Task and filter are found beside the config, by the spawned processes too; nearly all its time is imports."""
    short = ("seeds=[0]", "total_steps=128", "evaluation.episodes=1", FILTERED)
    process = start("compare", f"output={tmp_path}", *short, "--report")
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    said, folder = " ".join(out.split()), tmp_path / "fake"
    for text in (
        "training filtered seed 0: done",
        "evaluation filtered seed 0: done",
        "fake: one seed, no interval",
        "Training, all episodes",
        "Evaluation, filter off",
        "Evaluation, filter on",
        "Return per evaluation episode",
        f"Report: {folder / 'report.html'}",
    ):
        assert text in said, text
    assert (folder / "report.html").exists()
    run = folder / "filtered" / "seed_0"
    assert finish(run)["timesteps"] == 128
    assert len(read_rows(run / "evaluation" / "filter_on.csv")) == 1
    assert "| Evaluation, filter on |" in (run / "policy" / "README.md").read_text()
    assert (folder / "per_seed.csv").read_text().count("\n") == 1 + 3


@pytest.mark.slow
def test_a_killed_comparison_leaves_no_process_behind_and_goes_on(tmp_path, start):
    overrides = [f"output={tmp_path}", "total_steps=24000", "seeds=[0]", "checkpoint_every=1000", FILTERED]
    folder = tmp_path / "fake" / "filtered" / "seed_0"
    process = start("train", *overrides)
    wait_for(lambda: len(list(folder.glob("checkpoints/step_*/state.json"))) >= 2)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    # The workers notice and end: the rows stop growing, and the folder is free again.
    wait_for(lambda: not held(folder / ".lock"))
    at = max(int(path.name[5:]) for path in (folder / "checkpoints").glob("step_*"))
    early = [row for row in episodes(folder) if row["timesteps"] <= at]
    assert 1000 <= at < 24000 and not (folder / "finished.json").exists()
    process = start("train", *overrides)
    wait_for(lambda: len(episodes(folder)) > len(early) + 20)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert (process.returncode, err) == (130, "Stopped. The same command goes on.\n")
    assert "training filtered seed 0: stopped; goes on from step " in out and not held(folder / ".lock")
    out, err = start("train", *overrides).communicate(timeout=600)
    assert "training filtered seed 0: done" in out, err
    rows = episodes(folder)
    assert rows[: len(early)] == early
    assert sum(row["length"] for row in rows) <= 24_064  # nothing counted twice; whole rollouts
    assert finish(folder)["timesteps"] == 24_064


def test_help_and_mistakes_in_the_command_do_not_wait_for_torch():
    # Not yaml: numba reads its own settings with it.
    code = """
import sys
from safe_wrappers.train.cli import main
late = {"torch", "stable_baselines3", "sb3_contrib", "tensorboard", "matplotlib", "PIL", "gymnasium_robotics"}
late |= {"optuna", "ray", "sbx", "jax"}
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
        (["arms.filtered.filter=protect"], "no recipe for"),
        (["total_step=3"], "config: unknown name 'total_step'. Did you mean 'total_steps'?"),
        (["--on", "slurm"], "--on: expected ray or ray:ADDRESS"),
        (["--on", "ray:"], "--on: expected ray or ray:ADDRESS"),
    ],
)
def test_mistakes_are_lines_before_anything_starts(tmp_path, capsys, words, message):
    assert main(["train", str(FAKE), f"output={tmp_path}", "seeds=[0]", *words]) == 1
    captured = capsys.readouterr()
    assert "\nerror: " in "\n" + captured.err  # after what other packages say when they are imported
    assert message in captured.err and "Traceback" not in captured.err and "started" not in captured.out
    assert not list(tmp_path.iterdir())  # nothing that the corrected command could stumble over


# list and init ----------------------------------------------------------------------------------------------------


def listed(capsys, *kinds):
    """Kind -> name -> what is said of it."""
    assert main(["list", *kinds]) == 0
    found, kind = {}, ""
    for line in capsys.readouterr().out.splitlines():
        if heading := re.fullmatch(r"(\w+) \((\d+)\)", line):
            kind = heading[1]
            found[kind] = {}
        else:
            name, _, words = line.strip().partition("  ")
            found[kind][name] = words.strip()
    return found


def test_every_kind_is_listed_and_each_by_itself(capsys):
    found = listed(capsys)
    assert set(found) == {"envs", "recipes", "wrappers", "algorithms"}
    assert set(found["algorithms"]) == set(ALGORITHMS)
    assert set(found["recipes"]) == set(EVERY)
    assert listed(capsys, "wrappers") == {"wrappers": found["wrappers"]}
    # Envs can be made, and have a recipe.
    own = [name for name, words in found["envs"].items() if words == "of this library"]
    assert "SafeRover-v0" in own and len(own) >= 15
    for name in ("Reacher-v5", "SafePointGoal1-v0", "CartPole-v1"):
        assert name in found["envs"]
        sw.protect(gym.make(name))
    assert "Reacher-v4" not in found["envs"], "the newest version stands for all"
    assert "MountainCar-v0" not in found["envs"] and recipe_of("MountainCar-v0") is None


def test_what_init_writes_is_an_experiment(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["init"]) == 0
    assert capsys.readouterr().out == "Written: experiment.yaml\n"
    experiment = parse_experiment(read_config(tmp_path / "experiment.yaml"))
    arms = [(arm.name, arm.filter.kind) for arm in experiment.arms]
    assert (experiment.name, arms) == ("experiment", [("unfiltered", "none"), ("filtered", "protect")])
    for env_id, algorithm in (("Pendulum-v1", "TD3"), ("CartPole-v1", "DQN")):
        assert main(["init", f"{algorithm}.yaml", f"env={env_id}", f"algorithm={algorithm}"]) == 0
        arm = parse_experiment(read_config(tmp_path / f"{algorithm}.yaml")).arms[0]
        assert (arm.env.id, arm.algorithm) == (env_id, algorithm)


def test_every_comment_that_is_taken_away_leaves_an_experiment(tmp_path):
    path = tmp_path / "mine.yaml"
    assert main(["init", str(path)]) == 0
    lines = path.read_text().splitlines()
    options = [at for at, line in enumerate(lines) if re.match(r" *#\w+: ", line)]
    assert len(options) >= 6
    for chosen in [*([at] for at in options), options]:
        text = "\n".join(line.replace("#", "", 1) if at in chosen else line for at, line in enumerate(lines))
        path.write_text(text)
        assert yaml.safe_load(text) and parse_experiment(read_config(path)).name == "mine"


gym.register("MySwimmer-v0", "gymnasium.envs.mujoco.swimmer_v5:SwimmerEnv", max_episode_steps=20)


@pytest.mark.parametrize(
    ("words", "messages"),
    [
        (["there.yaml"], ["'there.yaml' is there already; give another name"]),
        (["env=Reachr-v5"], ["Did you mean 'Reacher-v5'"]),
        (["steps=3"], ["init: unknown name 'steps'"]),
        (["env=no_such_module:Some-v0"], ["No module named 'no_such_module'"]),
        (["env=CartPole-v1", "algorithm=SAC"], ["SAC needs actions of a Box"]),
        # With the lines that filter it.
        (["env=MySwimmer-v0"], ["no recipe", "env = sw.", '{factory: "module:function"}']),
    ],
)
def test_what_would_not_work_is_not_written(tmp_path, monkeypatch, words, messages, capsys):
    monkeypatch.chdir(tmp_path)
    Path("there.yaml").touch()
    assert main(["init", *words]) == 1
    told = capsys.readouterr().err
    assert all(message in told for message in messages)
    assert [path.name for path in tmp_path.iterdir()] == ["there.yaml"]


# enjoy and diagnose -----------------------------------------------------------------------------------------------

LINE = r"episode (\d): return -?[\d.]+, 20 steps, (\d+) in violation"


def test_enjoy_prints_a_line_per_episode_and_films_a_typical_one(finished, tmp_path, capsys):
    experiment = finished()
    run, film = str(experiment.run_folder(experiment.arms[1], 0)), tmp_path / "deep" / "film.webp"
    assert main(["enjoy", run, "--episodes", "3", "--output", str(film)]) == 0
    *lines, mean, said = capsys.readouterr().out.splitlines()
    assert [re.fullmatch(LINE + r", [\d.]+ % changed", line)[1] for line in lines] == ["0", "1", "2"]
    assert mean.startswith("filtered, filter trained, mean of 3 episodes: return ") and " 60 steps, " in mean
    returns = [float(re.search(r"return (-?[\d.]+)", line)[1]) for line in lines]
    assert f"Film: {film}. Episode {np.argsort(returns, kind='stable')[1]}, return" in said
    picture = Image.open(io.BytesIO(film.read_bytes()))
    assert picture.n_frames == 20 and picture.size == (WIDTH, HEIGHT + STRIP)
    assert main(["enjoy", run, "--episodes", "1", "--filter", "none"]) == 0
    line, _ = capsys.readouterr().out.splitlines()
    assert re.fullmatch(LINE, line), "without a filter nothing is changed, and nothing is said of it"
    for words, message in (
        ([run, "--render"], "has no render mode human; it has: rgb_array"),
        ([run, "--episodes", "0"], "--episodes: expected at least 1"),
        ([str(tmp_path)], "is no run's folder"),
    ):
        assert main(["enjoy", *words]) == 1
        assert message in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore")
def test_diagnose_prints_what_it_found_and_takes_the_policy_of_a_run_as_it_was_trained(
    fake_experiment, capsys
):
    assert main(["diagnose", "SafeRover-v0", "--steps", "60"]) == 0
    out = capsys.readouterr().out
    assert "  FOUND     wheel_slip" in out and "sw.SlipLimiter(env" in out and "give a policy" in out
    assert main(["diagnose", "Swimer-v5"]) == 1
    assert "Swimmer" in capsys.readouterr().err
    few = "hyperparameters={n_steps: 32, batch_size: 32, n_epochs: 1}"
    run = str(trained(fake_experiment("env=SafePointGoal1-v0", "action_repeat=2", "total_steps=32", few), 0))
    env, policy = of_run(run, "SafePointGoal1-v0")
    observation, _ = env.reset(seed=0)
    first = policy(observation)
    assert np.array_equal(policy(observation + 1.0), first)  # repeated: it was trained with action_repeat 2
    assert main(["diagnose", "SafePointGoal1-v0", "--policy", run, "--steps", "40"]) == 0
    out = capsys.readouterr().out
    assert "SafePointGoal1-v0: 40 steps\n" in out and "give a policy" not in out
    with pytest.raises(ConfigurationError, match="was trained on SafePointGoal1-v0, not on Swimmer-v5"):
        of_run(run, "Swimmer-v5")


def test_without_its_extra_the_command_says_how_to_install_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rich.console", None)
    assert main(["list"]) == 1
    assert "pip install 'safe-wrappers[train]'" in capsys.readouterr().err
