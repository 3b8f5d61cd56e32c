"""safe-wrappers list and init: names that exist, and a config that works, with each comment taken away, too."""

import re
import sys

import gymnasium as gym
import pytest
import yaml

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.protect import recipe_names, recipe_of
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import EnvConfig, FilterConfig, parse_experiment, read_config
from safe_wrappers.train.config.algorithms import ALGORITHMS
from safe_wrappers.train.experiment import check_training
from safe_wrappers.train.init import _LISTS as LISTS
from safe_wrappers.train.run.stack import make_stack


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


def test_every_kind_is_listed_and_each_by_itself(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").mkdir()
    text = "# yaml-language-server: $schema=schema.json\n# What it is for.\nname: a\narms: {}\n"
    (tmp_path / "configs" / "a.yaml").write_text(text)
    (tmp_path / "other.yaml").write_text("jobs: []\n")
    (tmp_path / "broken.yaml").write_text("a: [")
    found = listed(capsys)
    assert set(found) == set(LISTS)
    assert found["configs"] == {"configs/a.yaml": "What it is for."}
    assert set(found["algorithms"]) == set(ALGORITHMS)
    assert set(found["recipes"]) == set(recipe_names())
    assert listed(capsys, "wrappers") == {"wrappers": found["wrappers"]}


def test_wrappers_are_those_that_are_exported_with_what_they_do(capsys):
    (found,) = listed(capsys, "wrappers").values()
    assert {"CBFActionFilter", "VectorCBFActionFilter", "StuckEscape", "faults.Outages"} <= set(found)
    for name, words in found.items():
        assert words.endswith(".") or len(words) > 20, name
        assert name.startswith("faults.") or name in sw.__all__


def test_envs_can_be_made_and_those_with_a_recipe_protected(capsys):
    (found,) = listed(capsys, "envs").values()
    own = [name for name, words in found.items() if words == "of this library"]
    assert "SafeRover-v0" in own and len(own) >= 15
    for name in ("Reacher-v5", "SafePointGoal1-v0", "CartPole-v1"):
        assert name in found and recipe_of(name) is not None
        sw.protect(gym.make(name))
    assert "Reacher-v4" not in found, "the newest version stands for all"
    assert "MountainCar-v0" not in found and recipe_of("MountainCar-v0") is None
    (recipes,) = listed(capsys, "recipes").values()
    assert recipes["Reacher"] == "1 ids" and recipes["FetchReach"] in ("2 ids", "not installed here")


def test_an_unknown_kind_is_refused(capsys):
    assert main(["list", "env"]) == 1
    assert "list: unknown name 'env'. Did you mean 'envs'?" in capsys.readouterr().err


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


MINE = """
import gymnasium as gym
import numpy as np


class Swing(gym.Env):
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.zeros(2)
        return self.at.copy(), {}

    def step(self, action):
        self.at = self.at + 0.1 * np.array([self.at[1], float(action[0])])
        return self.at.copy(), 0.0, False, False, {}


gym.register("MySwing-v0", entry_point=Swing, max_episode_steps=20)
gym.register("MySwimmer-v0", entry_point="gymnasium.envs.mujoco.swimmer_v5:SwimmerEnv", max_episode_steps=20)
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A folder with a module of envs that no recipe knows."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "my_envs.py").write_text(MINE)
    yield tmp_path
    for name in ("my_envs", "a_1_filter", "my_filter"):
        sys.modules.pop(name, None)
    for name in ("MySwing-v0", "MySwimmer-v0"):
        gym.registry.pop(name, None)


def test_an_env_without_a_recipe_gets_a_module_with_its_filter(mine, capsys):
    assert main(["init", "a-1.yaml", "env=my_envs:MySwimmer-v0"]) == 0
    assert "a_1_filter.py" in capsys.readouterr().out
    experiment = parse_experiment(read_config(mine / "a-1.yaml"))
    assert [arm.filter.kind for arm in experiment.arms] == ["none", "factory"]
    filtered = make_stack(experiment.arms[1].env, experiment.arms[1].filter)
    filtered.reset(seed=0)
    assert "cbf/margin" in filtered.step(filtered.action_space.sample())[4]
    assert main(["init", "a 1.yaml", "env=my_envs:MySwimmer-v0"]) == 1, "the module is there already"
    assert not (mine / "a 1.yaml").exists()


def test_what_only_the_user_knows_is_asked_for_before_anything_is_trained(mine, capsys):
    assert main(["init", "a-1.yaml", "env=my_envs:MySwing-v0"]) == 0
    experiment = parse_experiment(read_config(mine / "a-1.yaml", ["total_steps=8"]))
    with pytest.raises(ConfigurationError, match=r"say in a_1_filter.py what must stay positive"):
        check_training(experiment)
    module = mine / "a_1_filter.py"
    given = re.sub(r"    raise .*", "    return 0.5 - abs(observation[1])", module.read_text())
    module.write_text(given)
    sys.modules.pop("a_1_filter")
    check_training(experiment)


def test_protect_without_a_recipe_is_refused_with_the_lines_that_filter_it(mine):
    with pytest.raises(ConfigurationError, match=r"(?s)no recipe .*env = sw\..*safe-wrappers init"):
        make_stack(EnvConfig(id="my_envs:MySwimmer-v0"), FilterConfig(protect={}))
