"""What a run's folder says of its arm is enough to have the arm again."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_run import Reports

from safe_wrappers.errors import ConfigurationError, RunStateError
from safe_wrappers.train.config import parse_experiment
from safe_wrappers.train.config.stored import stored_arm
from safe_wrappers.train.policies import load_policy
from safe_wrappers.train.run.training import train_run

PPO = {"algorithm": "PPO", "env": "SafePointGoal1-v0"}
SAC = {"algorithm": "SAC", "env": "SafePointGoal1-v0"}
ARMS = {
    "plain": {},
    "protect": {"filter": "protect"},
    "margin": {"filter": {"protect": {"margin": 0.1}}},
    "factory": {"filter": {"factory": "fake_task:shield", "kwargs": {"margin": 0.3}}},
    "leased": {"filter": {"protect": {}, "lease": {"budget": {"closing_speed": 3.0}}, "escape": {"progress": 0.1}}},
    "both": {**SAC, "filter": "protect", "learner": {"kind": "both", "penalty": 0.1, "per_correction": 2.0}},
    "map": {"filter": "protect", "learner": {"kind": "safe_set_map"}},
    "curriculum": {"filter": "protect", "learner": {"margin_curriculum": {"start": 0.1, "until": 0.5}}},
    "priced": {"hyperparameters": {"clip_range": "linear_0.2"}, "learner": {"cost_limit": 25}},
    "sized": {**SAC, "hyperparameters": {"buffer_size": 77, "train_freq": [1, "episode"]}},
    "begun": {"start_from": "plain", "normalize": {"observation": True}, "action_repeat": 4, "n_envs": 3},
    "faulty": {
        "env": {
            "id": "SafePointGoal1-v0", "kwargs": {"max_episode_steps": 50}, "observation": "constraints",
            "faults": {"Outages": {"mean_between_s": 2.0, "mean_length_s": 0.5}},
            "occlusion": None, "reset_options": {"layout": {"hazards": []}},
        }
    },
    "judged": {"env": {"id": "Reacher-v5", "judge": "constraints"}},
    "costly": {"env": {"id": "Reacher-v5", "cost": "fake_task:in_hazard"}},
}  # fmt: skip


def experiment():
    common = {"name": "x", "total_steps": 1000, "seeds": [0], **PPO}
    return parse_experiment({**common, "arms": ARMS, "evaluation": {"filter": "protect"}})


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_is_read_back_from_its_fingerprint(name):
    arm = next(arm for arm in experiment().arms if arm.name == name)
    again = stored_arm(name, json.loads(json.dumps(arm.fingerprint())))
    assert again.fingerprint() == arm.fingerprint()
    assert again == replace(arm, checkpoint_every=again.checkpoint_every)


def test_what_is_no_fingerprint_is_refused():
    for wrong in ({}, {"env": "Reacher-v5"}, []):
        with pytest.raises(ConfigurationError, match="expected the settings of a run"):
            stored_arm("a", wrong)
    with pytest.raises(ConfigurationError, match=r"arms\.a: unknown name 'later'"):
        stored_arm("a", {**experiment().arms[0].fingerprint(), "later": 1})


def test_a_policy_is_loaded_from_its_folder_and_acts_as_in_evaluation(fake_experiment, tmp_path):
    arm = next(arm for arm in fake_experiment("total_steps=128").arms if arm.name == "filtered")
    folder = tmp_path / "filtered" / "seed_0"
    train_run(arm, 0, folder, Reports().progress)
    trained = load_policy(str(folder))
    assert trained.arm.fingerprint() == arm.fingerprint()
    env, bare = trained.make_env(), trained.make_env("none")
    assert env.has_wrapper_attr("margin") and env.get_wrapper_attr("margin") == 0.02
    assert not bare.has_wrapper_attr("margin")
    observation, _ = env.reset(seed=0)
    scaling = trained._normalize
    seen = np.clip((observation - scaling.obs_rms.mean) / np.sqrt(scaling.obs_rms.var + 1e-8), -10, 10)
    proposed = trained.model.predict(seen, deterministic=True)[0]
    assert np.array_equal(trained(observation), proposed) and np.any(proposed)
    (folder / "run.json").write_text("{}")
    with pytest.raises(RunStateError, match="unreadable: KeyError"):
        load_policy(folder)
    (folder / "run.json").unlink()
    with pytest.raises(ConfigurationError, match=r"no run's folder \(it has no run\.json\)"):
        load_policy(folder)
