"""WholeBodyFilter: which constraints it is, what it refuses, and hostile states and actions."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.contacts import Replay

KINDS = {
    "forecast": sw.WholeBodyFilter,
    "pyramid": lambda env: sw.CBFActionFilter(env, [sw.constraints.Stance()]),
    "cone": lambda env: sw.CBFActionFilter(env, [sw.constraints.Stance(cone="exact")]),
}


def flagged(info):
    return bool(info["cbf/infeasible"] or info["cbf/fallback"])


def test_it_is_these_constraints():
    env = sw.WholeBodyFilter(gym.make("Hopper-v5"), friction_share=0.6, zmp_inset=0.02, tolerance=0.03)
    contact, support, joints = env.constraints
    assert contact == sw.constraints.ContactFeasibility(0.6, 0.03)
    assert support == sw.constraints.SupportMargin(0.02)
    names = ["thigh_joint", "leg_joint", "foot_joint"]
    stops = np.array([env.unwrapped.model.joint(name).range for name in names])
    assert joints.joints == names and joints.horizon == 3
    np.testing.assert_allclose([joints.lower, joints.upper], stops.T + np.array([[-0.1], [0.1]]))
    (alone,) = sw.WholeBodyFilter(gym.make("Hopper-v5"), joint_tolerance=None).constraints
    assert alone == sw.constraints.ContactFeasibility(0.7, 0.01)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"friction_share": 0.0}, "friction_share"),
        ({"friction_share": 1.1}, "friction_share"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"joint_tolerance": -0.1}, "joint_tolerance"),
        ({"zmp_inset": 0.0}, "inset"),
    ],
)
def test_bad_arguments_are_refused_in_words(arguments, words):
    with pytest.raises(ConfigurationError, match=words):
        sw.WholeBodyFilter(gym.make("Hopper-v5"), **arguments)


@pytest.mark.parametrize("contacts", KINDS)
def test_envs_that_have_no_contacts_to_keep_are_refused(contacts):
    for env_id in ("Reacher-v5", "InvertedPendulum-v5", "Swimmer-v5"):
        with pytest.raises(UnsupportedEnvError, match="no body of this model can touch"):
            KINDS[contacts](gym.make(env_id))
    with pytest.raises(UnsupportedEnvError, match="MuJoCo"):
        KINDS[contacts](gym.make("Pendulum-v1"))
    with pytest.raises(ConfigurationError, match="filtered already"):
        KINDS[contacts](KINDS[contacts](gym.make("Hopper-v5")))


def test_a_robot_without_stops_is_refused_unless_joints_are_left_alone():
    with pytest.raises(UnsupportedEnvError, match="joint_tolerance=None"):
        sw.WholeBodyFilter(gym.make("SafePointGoal1-v0"))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("contacts", KINDS)
@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Walker2d-v5"])
def test_states_that_are_none_and_states_that_mujoco_resets_never_pass_in_silence(env_id, contacts):
    env = KINDS[contacts](gym.make(env_id))
    for where, value in (
        ("qpos", np.nan),
        ("qvel", np.nan),
        ("qvel", np.inf),
        ("qvel", 1e11),
        ("qvel", 1e160),
        ("qvel", 1e300),
        ("qpos", 1e12),
    ):
        _, first = env.reset(seed=0)
        for _ in range(3):
            env.step(np.zeros(6, np.float32))
        getattr(env.unwrapped.data, where)[-1] = value
        info = env.step(np.full(6, 0.3, np.float32))[4]
        assert flagged(info), (where, value)
        assert np.isfinite(info["executed_action"]).all()
        assert env.action_space.contains(info["executed_action"].astype(np.float32))
        assert info.keys() >= first.keys() and all(
            np.isfinite(info[key]).all() for key in first if "/" in key
        )
        assert info["whole_body/cone_margin"] <= 0.0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("contacts", KINDS)
def test_actions_that_are_none_or_outside_do_not_get_through(contacts):
    env = KINDS[contacts](gym.make("HalfCheetah-v5"))
    env.reset(seed=0)
    for bad in (np.nan, np.inf, -np.inf, 1e30, 5.0):
        action = np.zeros(6)
        action[2] = bad
        info = env.step(action)[4]
        assert np.isfinite(info["executed_action"]).all() and (np.abs(info["executed_action"]) <= 1.0).all()
        assert info["cbf/fallback"] == (not np.isfinite(bad)) or flagged(info)
        assert info["cbf/correction"] > 0.0


def test_joints_stay_off_their_stops_at_every_evaluation():
    def beyond(env, action):
        replay, worst = Replay(env.unwrapped), [-np.inf]

        def look(data, _):
            at = data.qpos[3:9]
            worst.append(float(np.maximum(low - at, at - high).max()))

        replay.before()
        info = env.step(action)[-1]
        assert replay.after(look)
        return max(worst), info

    env, bare = sw.WholeBodyFilter(gym.make("HalfCheetah-v5")), gym.make("HalfCheetah-v5")
    low, high = env.unwrapped.model.jnt_range[3:9].T
    counts = {}
    for name, each in (("filtered", env), ("bare", bare)):
        outside = unflagged = 0
        each.reset(seed=0)
        for k in range(40):
            action = np.sign(np.random.default_rng(k // 8).normal(size=6)).astype(np.float32)
            far, info = beyond(each, action)
            outside += far > 0.1 + 1e-6
            unflagged += far > 0.1 + 1e-6 and name == "filtered" and not (flagged(info) or info["cbf/unsafe"])
        counts[name] = outside, unflagged
    assert counts["filtered"][1] == 0 and counts["bare"][0] > counts["filtered"][0]
