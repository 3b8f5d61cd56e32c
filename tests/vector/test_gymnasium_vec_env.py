"""GymnasiumVecEnv gives an SB3 learner what a DummyVecEnv of filtered envs gives."""

import csv

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_worlds import AtHazard

import safe_wrappers as sw

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from safe_wrappers.sb3 import GymnasiumVecEnv, InterventionCallback

ENVS, HORIZON, STEPS = 3, 30, 100


def point_goal():
    return AtHazard(gym.make("SafePointGoal1-v0", max_episode_steps=HORIZON))


def reacher():
    return gym.make("Reacher-v5", max_episode_steps=HORIZON)


def assert_same(one, other):
    assert set(one) == set(other)
    for key, value in one.items():
        np.testing.assert_allclose(value, other[key], rtol=1e-12, atol=0.0, err_msg=key)
        if not isinstance(value, dict):
            assert np.asarray(value).dtype == np.asarray(other[key]).dtype, key


@pytest.mark.filterwarnings("ignore:the policy's action left:UserWarning")
@pytest.mark.parametrize("make", [point_goal, reacher])
def test_it_is_a_dummy_vec_env_of_filtered_envs(make):
    dummy = DummyVecEnv([lambda: sw.protect(make())] * ENVS)
    vec_env = GymnasiumVecEnv(
        sw.protect(SyncVectorEnv([make] * ENVS, autoreset_mode=AutoresetMode.SAME_STEP))
    )
    for envs in (dummy, vec_env):
        envs.seed(3)
    np.testing.assert_array_equal(dummy.reset(), vec_env.reset())
    rng, changed = np.random.default_rng(0), 0
    for step in range(STEPS):
        if step % 15 == 0:
            actions = rng.choice([-1.2, 1.0], (ENVS, 2)).astype(np.float32)
        one, other = dummy.step(actions), vec_env.step(actions)
        for a, b in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        for a, b in zip(one[3], other[3], strict=True):
            assert_same(a, b)
        for a, b in zip(dummy.reset_infos, vec_env.reset_infos, strict=True):
            assert_same(a, b)
        changed += sum(info["cbf/intervened"] for info in one[3])
    assert changed > 3 and STEPS > 3 * HORIZON
    assert vec_env.get_attr("filter_calls") == dummy.get_attr("filter_calls") == [STEPS] * ENVS
    assert vec_env.env_is_wrapped(sw.CBFActionFilter) == [True] * ENVS
    vec_env.close()
    assert vec_env.vector_env.closed


def test_options_reach_the_envs_and_are_the_same_for_all():
    envs = gym.make_vec(
        "SafePointGoal1-v0",
        2,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
    )
    vec_env = GymnasiumVecEnv(sw.protect(envs))
    layout = {"layout": {"agent": [0.3, 0.1, 0.0]}}
    vec_env.set_options(layout)
    vec_env.reset()
    assert [env.data.qpos[0] for env in vec_env.get_attr("unwrapped")] == [0.3, 0.3]
    vec_env.set_options([layout, {}])
    with pytest.raises(sw.SafeWrappersError, match="the same options for all envs"):
        vec_env.reset()


def test_a_learner_trains_on_it_and_its_log_has_the_interventions(tmp_path):
    envs = SyncVectorEnv([point_goal] * 4, autoreset_mode=AutoresetMode.SAME_STEP)
    vec_env = VecMonitor(GymnasiumVecEnv(sw.protect(envs)))
    learner = PPO("MlpPolicy", vec_env, n_steps=32, batch_size=64, seed=0)
    learner.set_logger(configure(str(tmp_path), ["csv"]))
    learner.learn(256, callback=InterventionCallback())
    assert len(learner.ep_info_buffer) == 4 * (64 // HORIZON)
    with (tmp_path / "progress.csv").open() as file:
        rates = [row["interventions/step_rate"] for row in csv.DictReader(file)]
    assert len(rates) == 2 and all(0.0 <= float(rate) <= 1.0 for rate in rates) and float(rates[0]) > 0.0


def test_another_autoreset_mode_is_refused_with_the_way_out():
    envs = gym.make_vec("SafePointGoal1-v0", 2, vectorization_mode="sync")
    with pytest.raises(
        sw.SafeWrappersError, match=r"autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP"
    ):
        GymnasiumVecEnv(envs)
