"""safe-wrappers list and init: names that exist, and a config that works, with each comment taken away, too."""

import re

import gymnasium as gym
import pytest
import yaml

import safe_wrappers as sw
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import parse_experiment, read_config
from safe_wrappers.train.config.algorithms import ALGORITHMS
from safe_wrappers.train.init import _LISTS as LISTS
from safe_wrappers.wrappers.recipes import EVERY, recipe_of


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
    assert set(found) == set(LISTS)
    assert set(found["algorithms"]) == set(ALGORITHMS)
    assert set(found["recipes"]) == set(EVERY)
    assert listed(capsys, "wrappers") == {"wrappers": found["wrappers"]}


def test_envs_can_be_made_and_those_with_a_recipe_protected(capsys):
    (found,) = listed(capsys, "envs").values()
    own = [name for name, words in found.items() if words == "of this library"]
    assert "SafeRover-v0" in own and len(own) >= 15
    for name in ("Reacher-v5", "SafePointGoal1-v0", "CartPole-v1"):
        assert name in found and recipe_of(name) is not None
        sw.protect(gym.make(name))
    assert "Reacher-v4" not in found, "the newest version stands for all"
    assert "MountainCar-v0" not in found and recipe_of("MountainCar-v0") is None


# init ----------------------------------------------------------------------------------------------------------


def test_what_init_writes_is_an_experiment(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["init"]) == 0
    assert capsys.readouterr().out == "Written: experiment.yaml\n"
    experiment = parse_experiment(read_config(tmp_path / "experiment.yaml"))
    assert experiment.name == "experiment"
    assert [(arm.name, arm.filter.kind) for arm in experiment.arms] == [
        ("unfiltered", "none"),
        ("filtered", "protect"),
    ]
    assert main(["init"]) == 1
    assert "'experiment.yaml' is there already; give another name" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("env_id", "algorithm"),
    [("CartPole-v1", "PPO"), ("Pendulum-v1", "SAC"), ("Pendulum-v1", "TD3"), ("CartPole-v1", "DQN")],
)
def test_env_and_algorithm_are_filled_in(tmp_path, env_id, algorithm):
    path = tmp_path / "mine.yaml"
    assert main(["init", str(path), f"env={env_id}", f"algorithm={algorithm}"]) == 0
    arm = parse_experiment(read_config(path)).arms[0]
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env=Reachr-v5"], "Did you mean 'Reacher-v5'"),
        (["algorithm=PPPO"], "Did you mean 'PPO'"),
        (["steps=3"], "init: unknown name 'steps'"),
        (["env=no_such_module:Some-v0"], "No module named 'no_such_module'"),
        (["env=CartPole-v1", "algorithm=SAC"], "SAC needs actions of a Box"),
    ],
)
def test_what_would_not_work_is_not_written(tmp_path, words, message, capsys):
    path = tmp_path / "mine.yaml"
    assert main(["init", str(path), *words]) == 1
    assert message in capsys.readouterr().err
    assert not path.exists()


def test_an_env_without_a_recipe_is_refused_with_the_lines_that_filter_it(tmp_path, capsys):
    gym.register("MySwimmer-v0", "gymnasium.envs.mujoco.swimmer_v5:SwimmerEnv", max_episode_steps=20)
    path = tmp_path / "a.yaml"
    assert main(["init", str(path), "env=MySwimmer-v0"]) == 1
    told = capsys.readouterr().err
    assert "no recipe" in told and "env = sw." in told and '{factory: "module:function"}' in told
    assert not path.exists()
