"""What a run leaves for others: driven as it was trained, no foreign code, another env or filter refused."""

import json
import shutil
import subprocess
import sys
import types
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from running import SILENT

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, RunStateError
from safe_wrappers.train import policies
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import parse_experiment
from safe_wrappers.train.config.models import EvaluationConfig
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.evaluation.step_log import load_steps
from safe_wrappers.train.files import read_rows, write_rows
from safe_wrappers.train.policies import load_policy, write_card
from safe_wrappers.train.run.data_pickles import read_pickle
from safe_wrappers.train.run.stack import make_vec_env
from safe_wrappers.train.run.training import train_run

SHIPPED = Path(__file__).parents[2] / "configs" / "policies"
REACHER = {
    "name": "x",
    "env": "Reacher-v5",
    "seeds": [0],
    "total_steps": 64,
    "arms": {"a": {"filter": "protect"}},
}
SMALL = {"policy_kwargs": {"net_arch": [8]}}
PPO = {"algorithm": "PPO", "hyperparameters": {"n_steps": 16, **SMALL}, "n_envs": 4}
PPO |= {"normalize": {"observation": True}}
SAC = {"algorithm": "SAC", "hyperparameters": {"learning_starts": 40, "use_sde": True, **SMALL}}
SBX = {**SAC, "algorithm": "sbx.SAC"}
DQN = {"algorithm": "DQN", "env": "CartPole-v1", "arms": {"a": {"filter": "none"}}, "hyperparameters": SMALL}


def trained(settings, tmp_path):
    """The folder of a finished run."""
    (arm,) = parse_experiment({**REACHER, **settings}).arms
    folder = tmp_path / "seed_0"
    train_run(arm, 0, folder, SILENT)
    return folder


@pytest.fixture(scope="module")
def reacher(tmp_path_factory):
    return trained(PPO, tmp_path_factory.mktemp("reacher"))


@pytest.fixture
def policy(reacher, tmp_path):
    """A copy of its policy's folder, to break."""
    return shutil.copytree(reacher / "policy", tmp_path / "policy")


@pytest.mark.parametrize(
    "settings", [None, SAC, DQN, pytest.param(SBX, marks=pytest.mark.slow)], ids=["PPO", "SAC", "DQN", "sbx"]
)
def test_its_folder_acts_as_the_run_does(settings, reacher, tmp_path):
    if settings is SBX:
        pytest.importorskip("sbx")
    run = reacher if settings is None else trained(settings, tmp_path)
    of_run, of_folder = load_policy(run), load_policy(str(run / "policy"))
    assert of_folder.arm.fingerprint() == of_run.arm.fingerprint()
    versions = json.loads((run / "policy" / "config.json").read_text())["versions"]
    assert ("sbx-rl" in versions) == (settings is SBX)
    env = of_run.make_env()
    observation, _ = env.reset(seed=0)
    if settings is None:  # it sees scaled observations and has its filter
        assert env.has_wrapper_attr("filter") and not of_run.make_env("none").has_wrapper_attr("filter")
        scaling = read_pickle(run / "policy" / "vecnormalize.pkl").obs_rms
        seen = np.clip((observation - scaling.mean) / np.sqrt(scaling.var + 1e-8), -10, 10)
        assert np.array_equal(of_run(observation), of_run.model.predict(seen, deterministic=True)[0])
    for _ in range(8):
        action = of_run(observation)
        np.testing.assert_array_equal(of_folder(observation), action)
        observation = env.step(action)[0]


SEEN = {
    "env": {"id": "SafePointGoal1-v0", "observation": "constraints", "kwargs": {"max_episode_steps": 50}},
    "hyperparameters": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    "total_steps": 16,
    "action_repeat": 4,
}


def test_it_acts_in_evaluation_as_it_was_trained(tmp_path):
    """Beside SB3's own `predict` in a loop over ActionRepeat."""
    run = trained({**PPO, **SEEN, "normalize": None, "n_envs": 1}, tmp_path)
    policy = load_policy(run)
    arm = policy.arm
    envs = make_vec_env(arm)
    envs.reset()
    dones = [envs.step(np.zeros((1, 2), dtype=np.float32))[2][0] for _ in range(13)]
    assert dones[-1] and not any(dones[:-1])  # its steps are the policy's
    evaluate_run(arm, 0, run, EvaluationConfig(episodes=2, seed=7), arm.filter, SILENT)
    env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=50)))
    env = sw.ActionRepeat(sw.RecordInterventions(env), 4)
    for seed, row in zip((7, 8), read_rows(run / "evaluation" / "filter_on.csv"), strict=True):
        observation, _ = env.reset(seed=seed)
        truncated = False
        while not truncated:
            action = policy.model.predict(observation, deterministic=True)[0]
            observation, _, _, truncated, info = env.step(action)
        assert row["return"] == pytest.approx(info["interventions"]["return"], abs=1e-12)
        assert row["length"] == 50
    held = load_steps(run / "evaluation" / "filter_on_steps.npz").proposed[:48].reshape(12, 4, 2)
    assert (held == held[:, :1]).all()
    policy.deterministic = False
    policy.reset()
    first = policy(observation)
    policy.reset()
    assert not np.array_equal(policy(observation), first)


def test_fetch_reach_is_trained_and_evaluated_by_its_plain_id(tmp_path):
    pytest.importorskip("gymnasium_robotics")
    short = {"hyperparameters": {"n_steps": 50, "batch_size": 50, "n_epochs": 1}, "total_steps": 100}
    run = trained({**PPO, **short, "env": "FetchReach-v4", "n_envs": 2}, tmp_path)
    policy = load_policy(run)
    assert type(policy.model.policy).__name__ == "MultiInputActorCriticPolicy"  # its observations are dicts
    evaluate_run(policy.arm, 0, run, EvaluationConfig(episodes=1), policy.arm.filter, SILENT)
    (row,) = read_rows(run / "evaluation" / "filter_on.csv")
    assert row["length"] == 50
    code = (  # a new process registers the id when it is asked for
        "import gymnasium as gym; from safe_wrappers.train.config.models import check_env_id;"
        "assert 'FetchReach-v4' not in gym.registry; check_env_id('FetchReach-v4');"
        "assert 'FetchReach-v4' in gym.registry"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("name", ["filtered", "unfiltered"])
def test_the_policies_that_ship_act_safely_in_their_filter(name):
    trained = load_policy(SHIPPED / name)
    env = trained.make_env("protect")
    observation, _ = env.reset(seed=0)
    trained.reset()
    for _ in range(100):
        observation, _, _, _, info = env.step(trained(observation))
        assert info["cost"] == 0.0


def test_what_is_no_policy_or_unreadable_is_refused(policy, tmp_path):
    (policy / "model.zip").write_bytes(b"x")
    with pytest.raises(RunStateError, match=r"model\.zip' cannot be read"):
        load_policy(policy)
    (policy / "config.json").write_text("{}")
    with pytest.raises(ConfigurationError, match="no run's folder"):
        load_policy(policy)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(ConfigurationError, match="has no checkpoint yet"):
        load_policy(tmp_path)


def test_another_env_is_refused_unless_told(policy):
    with pytest.raises(ConfigurationError, match="is for another observation space"):
        load_policy(policy, sw.protect(gym.make("HalfCheetah-v5")))
    older = sw.protect(gym.make("Reacher-v5", max_episode_steps=20))
    assert load_policy(policy, older).arm.env.id == "Reacher-v5"
    gym.register("OtherReacher-v5", gym.spec("Reacher-v5").entry_point, max_episode_steps=50)
    other = sw.CBFActionFilter(gym.make("OtherReacher-v5"), older.constraints)
    with pytest.raises(ConfigurationError, match="trained on Reacher-v5, not on OtherReacher-v5"):
        load_policy(policy, other)
    load_policy(policy, other, other_env=True)


@pytest.mark.parametrize("run_or_folder", ["", "policy"])
def test_another_filter_is_refused_unless_told(reacher, run_or_folder, monkeypatch):
    folder, limit = reacher / run_or_folder, sw.constraints.JointSpeedLimit(limit=4.0)
    for env, here in (
        (gym.make("Reacher-v5"), "here: no filter"),
        (sw.CBFActionFilter(gym.make("Reacher-v5"), [limit]), r"here: JointSpeedLimit\(limit=4\.0"),
    ):
        with pytest.raises(ConfigurationError, match=rf"(?s)trained: JointSpeedLimit\(limit=5\.0.*{here}"):
            load_policy(folder, env)
        load_policy(folder, env, other_filter=True)
    load_policy(folder, sw.RecordInterventions(sw.protect(gym.make("Reacher-v5"))))
    # So is, for a policy's folder, a recipe that has changed since.
    monkeypatch.setattr(policies, "constraints_of_arm", lambda arm: ["JointSpeedLimit(limit=9.0)"])
    with pytest.raises(ConfigurationError, match=r"(?s)through another filter.*limit=9\.0"):
        load_policy(reacher / "policy")
    load_policy(reacher / "policy", other_filter=True)


def test_the_card_has_what_was_measured_and_says_what_was_not_judged(reacher, tmp_path):
    run = shutil.copytree(reacher, tmp_path / "seed_0")
    arm = load_policy(run).arm
    card = run / "policy" / "README.md"
    (run / "episodes.csv").unlink()
    write_card(arm, 0, run)
    assert "Nothing was measured yet." in card.read_text()
    row = {"return": -4.0, "length": 50, "intervention_rate": 0.5, "infeasible": 1}
    write_rows(run / "evaluation" / "filter_on.csv", row, [row, {**row, "return": -8.0}])
    write_card(arm, 0, run)
    text = card.read_text()
    for line in (
        "# PPO on `Reacher-v5`",
        "|  | Steps | Return / episode | Cost / episode | Steps in violation, total | Share of steps changed |",
        "| Evaluation, filter on | 100 | -6 | not judged | not judged | 0.5 | 2 | - |",
        "trained for 64 steps, filter `protect`", "* `JointSpeedLimit(limit=5.0",
    ):  # fmt: skip
        assert line in text, line


# The hub --------------------------------------------------------------------------------------------------------


def test_a_policy_goes_to_the_hub_and_comes_back(reacher, tmp_path, monkeypatch, capsys):
    """By huggingface_sb3 as far as it is used here; files are looked for where it does."""

    def push_to_hub(repo_id, filename, commit_message):
        shutil.copy(filename, tmp_path / filename)

    def load_from_hub(repo_id, filename):
        return str(tmp_path / filename)

    package = types.SimpleNamespace(push_to_hub=push_to_hub, load_from_hub=load_from_hub)
    monkeypatch.setitem(sys.modules, "huggingface_sb3", package)
    write_card(load_policy(reacher).arm, 0, reacher)
    assert main(["push", str(reacher), "me/reacher"]) == 0
    assert "Uploaded: config.json, model.zip, vecnormalize.pkl, README.md" in capsys.readouterr().out
    there, here = load_policy("hub:me/reacher"), load_policy(reacher)
    observation, _ = here.make_env().reset(seed=0)
    np.testing.assert_array_equal(there(observation), here(observation))


def test_a_policy_imports_no_module_that_was_not_named(policy, tmp_path, monkeypatch):
    (tmp_path / "unread.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\ndef f(env): return env\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    plain = json.loads((policy / "config.json").read_text())
    factory = {"factory": "unread:f", "kwargs": {}}
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
            load_policy(policy, imports=["json"], other_filter=True)
        assert not (tmp_path / "ran").exists()
    config = {**plain, "config": {**arm, "filter": factory}, "constraints": []}
    (policy / "config.json").write_text(json.dumps(config))
    assert main(["enjoy", str(policy), "--episodes", "1"]) == 1
    assert not (tmp_path / "ran").exists()
    assert main(["enjoy", str(policy), "--episodes", "1", "--imports", "unread"]) == 0
    assert (tmp_path / "ran").exists()
    sys.modules.pop("unread")
