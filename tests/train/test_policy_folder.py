"""What a run leaves for others: the same actions, nothing pickled, another env or filter refused."""

import json
import os
import pickle
import shutil
import subprocess
import sys
import types

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hub_server import serving
from rich.console import Console
from test_run import Reports

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, RunStateError
from safe_wrappers.train import experiment as experiment_module
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import FilterConfig, parse_experiment
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.policies import load_policy
from safe_wrappers.train.policies.card import write_card
from safe_wrappers.train.policies.hub import download, upload
from safe_wrappers.train.run import Progress, portable
from safe_wrappers.train.run.training import train_run
from safe_wrappers.train.tables import write_rows

REACHER = {
    "name": "x",
    "env": "Reacher-v5",
    "seeds": [0],
    "total_steps": 64,
    "arms": {"a": {"filter": "protect"}},
}
SMALL = {"policy_kwargs": {"net_arch": [8]}}
PPO = {
    "algorithm": "PPO",
    "hyperparameters": {"n_steps": 16, **SMALL},
    "n_envs": 4,
    "normalize": {"observation": True},
}
SAC = {"algorithm": "SAC", "hyperparameters": {"learning_starts": 40, "use_sde": True, **SMALL}}
HER = {
    "algorithm": "TD3", "env": "FetchReach-v4", "total_steps": 120, "normalize": {"observation": True},
    "hyperparameters": {
        "learning_starts": 60, "action_noise": "none", "replay_buffer_class": "HerReplayBuffer", **SMALL,
    },
    "arms": {"a": {"filter": "protect", "learner": {"kind": "both", "penalty": 0.1}}},
}  # fmt: skip
DQN = {"algorithm": "DQN", "env": "CartPole-v1", "arms": {"a": {"filter": "none"}}, "hyperparameters": SMALL}


def trained(settings, tmp_path):
    """The folder of a finished run."""
    (arm,) = parse_experiment({**REACHER, **settings}).arms
    folder = tmp_path / "seed_0"
    train_run(arm, 0, folder, Reports().progress)
    return folder


@pytest.fixture(scope="module")
def reacher(tmp_path_factory):
    return trained(PPO, tmp_path_factory.mktemp("reacher"))


@pytest.fixture
def policy(reacher, tmp_path):
    """A copy of its policy's folder, to break."""
    return shutil.copytree(reacher / "policy", tmp_path / "policy")


@pytest.mark.parametrize("settings", [PPO, SAC, HER, DQN], ids=["PPO", "SAC", "HER", "DQN"])
def test_it_acts_as_the_checkpoint_does_and_nothing_is_unpickled(settings, tmp_path, monkeypatch):
    if settings is HER:
        pytest.importorskip("gymnasium_robotics")
    run = trained(settings, tmp_path)
    of_run = load_policy(run)

    def forbidden(*args, **kwargs):
        raise AssertionError("something was unpickled")

    for module, name in ((pickle, "load"), (pickle, "loads"), (torch, "load")):
        monkeypatch.setattr(module, name, forbidden)
    of_folder = load_policy(run / "policy")
    assert of_folder.arm.fingerprint() == of_run.arm.fingerprint()
    env = of_run.make_env()
    observation, _ = env.reset(seed=0)
    for _ in range(8):
        action = of_run(observation)
        np.testing.assert_array_equal(of_folder(observation), action)
        observation = env.step(action)[0]
    of_folder.model.policy.load_state_dict(of_run.model.policy.state_dict())  # the same networks
    for name in np.load(run / "policy" / "model.npz").files:
        assert "target" not in name, "a policy that acts needs no lagging copies"
    assert {path.suffix for path in (run / "policy").iterdir()} <= {".npz", ".json", ".md"}
    for path in (run / "policy").glob("*.npz"):
        np.load(path, allow_pickle=False)


def test_a_file_that_was_changed_is_refused(policy):
    arrays = dict(np.load(policy / "model.npz"))
    np.savez(policy / "model.npz", **{name: array + 1 for name, array in arrays.items()})
    with pytest.raises(RunStateError, match=r"model\.npz is not as it was written"):
        load_policy(policy)
    (policy / "config.json").write_text("[]")
    with pytest.raises(RunStateError, match="unreadable: TypeError"):
        load_policy(policy)
    (policy / "config.json").unlink()
    with pytest.raises(ConfigurationError, match=r"no policy's \(it has no config\.json\)"):
        load_policy(policy)


def test_another_env_is_refused_unless_told(policy):
    with pytest.raises(ConfigurationError, match="is for another observation space"):
        load_policy(policy, sw.protect(gym.make("HalfCheetah-v5")))
    older = sw.protect(gym.make("Reacher-v5", max_episode_steps=20))
    assert load_policy(policy, older).arm.env.id == "Reacher-v5"
    with pytest.raises(ConfigurationError, match="another observation space"):
        load_policy(policy, sw.protect(gym.make("Reacher-v4")))
    gym.register("OtherReacher-v5", gym.spec("Reacher-v5").entry_point, max_episode_steps=50)
    other = sw.CBFActionFilter(gym.make("OtherReacher-v5"), older.constraints)
    with pytest.raises(ConfigurationError, match="trained on Reacher-v5, not on OtherReacher-v5"):
        load_policy(policy, other)
    load_policy(policy, other, other_env=True)


@pytest.mark.parametrize("run_or_folder", ["", "policy"])
def test_another_filter_is_refused_unless_told(reacher, run_or_folder):
    limit = sw.constraints.JointSpeedLimit(limit=4.0)
    for env, here in (
        (gym.make("Reacher-v5"), "here: no filter"),
        (sw.CBFActionFilter(gym.make("Reacher-v5"), [limit]), r"here: JointSpeedLimit\(limit=4\.0"),
    ):
        with pytest.raises(ConfigurationError, match=rf"(?s)trained: JointSpeedLimit\(limit=5\.0.*{here}"):
            load_policy(reacher / run_or_folder, env)
        load_policy(reacher / run_or_folder, env, other_filter=True)
    load_policy(reacher / run_or_folder, sw.RecordInterventions(sw.protect(gym.make("Reacher-v5"))))


def test_a_recipe_that_has_changed_since_is_refused_unless_told(policy, monkeypatch):
    monkeypatch.setattr(portable, "constraints_of", lambda env: ["JointSpeedLimit(limit=9.0)"])
    with pytest.raises(ConfigurationError, match=r"(?s)than this version of the library makes.*limit=9\.0"):
        load_policy(policy)
    load_policy(policy, other_filter=True)


def test_a_filter_of_ones_own_is_told_from_none(fake_experiment, tmp_path):
    arm = fake_experiment("total_steps=128").arms[1]
    train_run(arm, 0, tmp_path / "seed_0", Reports().progress)
    bare = gym.make("fake_task:FakeGoal-v0")
    with pytest.raises(ConfigurationError, match=r"(?s)trained: FakeFilter\n  here: no filter"):
        load_policy(tmp_path / "seed_0" / "policy", bare, imports=["fake_task"])


def test_training_for_longer_takes_the_old_policy_away_and_writes_the_new_one(fake_experiment, tmp_path):
    folder = tmp_path / "seed_0"
    there = []
    progress = Progress(steps=lambda _: there.append((folder / "policy").exists()), say=print)
    for steps in (128, 256):
        train_run(fake_experiment(f"total_steps={steps}").arms[1], 0, folder, progress)
        assert there and not any(there), "while it trains there is none that is out of date"
        assert json.loads((folder / "policy" / "config.json").read_text())["timesteps"] == steps
        (folder / "policy" / "mine").touch()
    assert not (folder / "policy" / ".policy").exists()


@pytest.mark.parametrize("space", [
    spaces.Box(-1.0, np.array([1.0, np.inf]), (2,), np.float64), spaces.Box(0, 255, (4, 4, 3), np.uint8),
    spaces.Discrete(3), spaces.Discrete(3, start=1), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(4),
    spaces.Dict(b=spaces.Box(-1, 1, (2,)), a=spaces.Discrete(2)),
], ids=str)  # fmt: skip
def test_spaces_come_back_from_json(space):
    again = portable._space(json.loads(json.dumps(portable._described(space))))
    assert again == space and (not isinstance(space, spaces.Dict) or list(again) == list(space))


def test_a_space_that_sb3_does_not_take_is_refused():
    with pytest.raises(ConfigurationError, match="Stable-Baselines3 does not take: Text"):
        portable._described(spaces.Text(3))


# The card -------------------------------------------------------------------------------------------------------


def test_the_card_has_what_was_measured_and_says_what_was_not_judged(reacher, tmp_path):
    run = shutil.copytree(reacher, tmp_path / "seed_0")
    arm = load_policy(run).arm
    card = run / "policy" / "README.md"
    (run / "episodes.csv").unlink()
    write_card(arm, 0, run, FilterConfig())
    assert "Nothing was measured yet." in card.read_text()
    columns = ("return", "length", "intervention_rate", "infeasible")
    rows = [
        {"return": value, "length": 50, "intervention_rate": 0.5, "infeasible": 1} for value in (-4.0, -8.0)
    ]
    write_rows(run / "evaluation" / "filter_on.csv", columns, rows)
    write_card(arm, 0, run, FilterConfig())
    text = card.read_text()
    for line in (
        "# PPO on Reacher-v5", "| Episodes; steps | 2; 100 |", "| Return / episode | -6 |",
        "| Share of steps changed | 0.5 |",
        "| Steps in violation, total | not judged |", "| Infeasible steps, total | 2 |",
        "| Fallback steps, total | - |",
        "trained for 64 steps through the filter `protect`", "* `JointSpeedLimit(limit=5.0",
    ):  # fmt: skip
        assert line in text, line
    load_policy(run / "policy")  # the card is no part of what is verified


def test_training_and_evaluating_an_experiment_write_the_cards(fake_experiment, monkeypatch):
    experiment = fake_experiment("total_steps=128", "seeds=[0]", "evaluation.episodes=1")
    arm, progress = experiment.arms[1], Reports().progress
    run = experiment.run_folder(arm, 0)
    card = run / "policy" / "README.md"
    monkeypatch.setattr(experiment_module, "run_jobs", lambda *jobs, **where: None)
    monkeypatch.setattr(experiment_module, "record_videos", lambda *jobs: None)
    for each in experiment.arms:
        train_run(each, 0, experiment.run_folder(each, 0), progress)
    assert not card.exists()
    experiment_module.train_experiment(experiment, Console())
    assert "| Training, all episodes |" in card.read_text()
    evaluate_run(arm, 0, run, experiment.evaluation, arm.filter, progress)
    experiment_module.evaluate_experiment(experiment, Console())
    assert "| Training, all episodes | Evaluation, filter off | Evaluation, filter on |" in card.read_text()


# The hub --------------------------------------------------------------------------------------------------------


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """huggingface_sb3 as far as it is used here, with a folder for a hub; files are looked for where it does."""
    there = tmp_path / "hub"

    def push_to_hub(repo_id, filename, commit_message):
        (there / repo_id).mkdir(parents=True, exist_ok=True)
        shutil.copy(filename, there / repo_id / filename)

    def load_from_hub(repo_id, filename):
        return str(there / repo_id / filename)

    package = types.SimpleNamespace(push_to_hub=push_to_hub, load_from_hub=load_from_hub)
    monkeypatch.setitem(sys.modules, "huggingface_sb3", package)
    return there


def test_a_policy_goes_to_the_hub_and_comes_back(reacher, hub, capsys):
    arm = load_policy(reacher).arm
    write_card(arm, 0, reacher, FilterConfig())
    assert main(["push", str(reacher), "me/reacher"]) == 0
    assert (
        "Uploaded: config.json, filter.json, model.npz, normalisation.npz, README.md"
        in capsys.readouterr().out
    )
    there, here = load_policy("hub:me/reacher"), load_policy(reacher)
    observation, _ = here.make_env().reset(seed=0)
    np.testing.assert_array_equal(there(observation), here(observation))
    assert main(["enjoy", "hub:me/reacher", "--episodes", "1"]) == 0
    assert "episode 0: return" in capsys.readouterr().out


THROUGH_THE_HUB = """
import sys
import numpy as np
from safe_wrappers.train.cli import main
from safe_wrappers.train.policies import load_policy
run = sys.argv[1]
assert main(["push", run, "me/reacher"]) == 0
there, here = load_policy("hub:me/reacher"), load_policy(run)
observation, _ = here.make_env().reset(seed=0)
np.testing.assert_array_equal(there(observation), here(observation))
assert main(["enjoy", "hub:me/reacher", "--episodes", "1"]) == 0
"""


def test_the_real_package_takes_it_there_and_back(reacher, tmp_path):
    pytest.importorskip("huggingface_sb3", reason="pip install 'safe-wrappers[hub]'")
    write_card(load_policy(reacher).arm, 0, reacher, FilterConfig())
    card = (reacher / "policy" / "README.md").read_text()
    with serving(tmp_path / "hub") as url:  # huggingface_hub reads the variables when it is imported
        env = {"HF_ENDPOINT": url, "HF_HOME": str(tmp_path / "home"), "HF_TOKEN": "hf_stub"}
        done = subprocess.run(
            [sys.executable, "-c", THROUGH_THE_HUB, str(reacher)],
            env={**os.environ, **env},
            capture_output=True,
            text=True,
        )
    assert done.returncode == 0, done.stderr
    assert "Uploaded: config.json" in done.stdout and "episode 0: return" in done.stdout
    there = tmp_path / "hub" / "me" / "reacher"
    for name in ("config.json", "filter.json", "model.npz", "normalisation.npz"):
        assert (there / name).read_bytes() == (reacher / "policy" / name).read_bytes()
    assert (there / "README.md").read_text().splitlines()[-5:] == card.splitlines()[-5:]


def test_what_cannot_go_there_is_refused(policy, hub, tmp_path, monkeypatch, capsys):
    for name in ("me", "me/", "a/b/c"):
        with pytest.raises(ConfigurationError, match="expected owner/name"):
            upload(policy, name)
    with pytest.raises(ConfigurationError, match="no policy's folder"):
        upload(tmp_path / "none", "me/reacher")
    upload(policy, "me/reacher")
    config = hub / "me" / "reacher" / "config.json"
    config.write_text(config.read_text().replace("filter.json", "../../escape"))
    with pytest.raises(ConfigurationError, match="names a file that no policy has"):
        download("me/reacher")
    monkeypatch.setitem(sys.modules, "huggingface_sb3", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'safe-wrappers\[hub\]'"):
        upload(policy, "me/reacher")
    with pytest.raises(SystemExit):
        main(["push", str(policy)])
    assert "push takes a RUN and owner/name" in capsys.readouterr().err


# Modules --------------------------------------------------------------------------------------------------------


def test_a_policy_imports_no_module_that_was_not_named(reacher, policy, tmp_path, monkeypatch):
    (tmp_path / "unread.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\ndef f(env): return env\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    plain = json.loads((policy / "config.json").read_text())
    factory = {"kind": "factory", "factory": "unread:f", "kwargs": {}}
    arm = plain["config"]
    for place, config in {
        "filter.factory": {**arm, "filter": factory},
        "env.cost": {**arm, "env": {**arm["env"], "cost": "unread:f"}},
        "env.judge.factory": {**arm, "env": {**arm["env"], "judge": factory}},
        "env.observation.factory": {**arm, "env": {**arm["env"], "observation": factory}},
        "env.id": {**arm, "env": {**arm["env"], "id": "unread:Reacher-v5"}},
    }.items():
        (policy / "config.json").write_text(json.dumps({**plain, "config": config}))
        with pytest.raises(
            ConfigurationError, match=rf"wants the module 'unread' \({place} of its config.json\)"
        ):
            load_policy(policy)
        with pytest.raises(ConfigurationError, match="wants the module 'unread'"):
            load_policy(policy, imports=["json"], other_filter=True)
        assert not (tmp_path / "ran").exists()
    assert main(["enjoy", str(policy), "--episodes", "1"]) == 1
    assert not (tmp_path / "ran").exists()
    assert main(["enjoy", str(policy), "--episodes", "1", "--imports", "unread"]) == 0
    assert (tmp_path / "ran").exists()
    sys.modules.pop("unread")
