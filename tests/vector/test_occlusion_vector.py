"""OcclusionPenalty, filter and recorder in vector envs: in every mode the single envs, bit for bit; SB3's alike."""

import contextlib
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from single_loops import assert_same_info
from vector_worlds import KINDS, WAYS

import safe_wrappers as sw

SEED, STEPS, LENGTH = 5, 30, 9
pytestmark = [
    pytest.mark.filterwarnings("ignore:the policy's action is not finite:UserWarning"),
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
]


def make(_index=0):
    cars = sw.occlusion.Track(
        "car*", acceleration_noise=[0.0225, 0.0], reversion_s=2.0, start_position_std=[0.3, 0.0]
    )
    eye = sw.occlusion.Sensor("eye", view_deg=120, range_m=6.0)
    task = gym.make("OccludedCrossing-v0", max_episode_steps=LENGTH)
    env = sw.OcclusionPenalty(task, [cars], eye, tolerance=0.5, weight=0.1)
    return sw.RecordInterventions(sw.protect(env, cars="estimated"))


def episode(seed):
    """What one env that is reset with a seed does, wherever else it is run."""
    env = make()
    told = [env.reset(seed=seed)]
    told += [env.step(np.ones(3, np.float32)) for _ in range(LENGTH)]
    return told


@pytest.mark.parametrize(("kind", "mode"), WAYS)
def test_first_episodes_are_the_single_envs(kind, mode):
    envs = KINDS[kind]([partial(make, i) for i in range(2)], autoreset_mode=mode)
    wanted = [episode(SEED + i) for i in range(2)]
    with contextlib.closing(envs):
        observations, infos = envs.reset(seed=SEED)
        for i in range(2):
            assert observations[i].tobytes() == wanted[i][0][0].tobytes()
        for t in range(1, LENGTH):
            observations, rewards, _, truncated, infos = envs.step(np.ones((2, 3), np.float32))
            for i in range(2):
                observation, reward, _, over, info = wanted[i][t]
                assert observations[i].tobytes() == observation.tobytes() and rewards[i] == reward
                assert truncated[i] == over
                got = {key: values[i] for key, values in infos.items() if not key.startswith("_")}
                assert_same_info(got, info, f"sub-env {i}, step {t}")


def test_later_episodes_go_on_with_the_noise_and_not_with_the_estimates():
    # A wrapper's own generator goes on; so the oracle is the same env reset by hand.
    envs = SyncVectorEnv([make], autoreset_mode=AutoresetMode.NEXT_STEP)
    single = make()
    single.reset(seed=SEED)
    envs.reset(seed=SEED)
    resets = 0
    over = False
    for _ in range(STEPS):
        observations, _, _, truncated, infos = envs.step(np.ones((1, 3), np.float32))
        if over:
            observation, info = single.reset()
            resets += 1
        else:
            observation, _, _, over_now, info = single.step(np.ones(3, np.float32))
            assert over_now == truncated[0]
        over = bool(truncated[0])
        assert observations[0].tobytes() == observation.tobytes()
        np.testing.assert_array_equal(infos["occlusion/sigma"][0], info["occlusion/sigma"])
        if over:
            assert infos["interventions"]["seen"][0] == info["interventions"]["seen"]
    assert resets >= 2
