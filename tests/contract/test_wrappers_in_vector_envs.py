"""Every exported wrapper inside Gymnasium's vector envs: what each env says arrives whole."""

import contextlib

import gymnasium as gym
import numpy as np
import pytest
from episodes import actions
from wrapper_examples import CASES, build


@pytest.mark.parametrize(("name", "case"), CASES)
@pytest.mark.parametrize(
    ("kind", "mode"),
    # A process sends what its env gives; the mode in which it sends two infos at once is enough.
    [("async", gym.vector.AutoresetMode.SAME_STEP)] + [("sync", mode) for mode in gym.vector.AutoresetMode],
)
def test_inside_vector_envs_infos_are_whole(name, case, kind, mode):
    single = build(name, case)
    single.reset(seed=0)
    steps = actions(single, 25)
    kinds = {"sync": gym.vector.SyncVectorEnv, "async": gym.vector.AsyncVectorEnv}

    def make():
        return gym.wrappers.TimeLimit(build(name, case), 10)

    with contextlib.closing(kinds[kind]([make, make], autoreset_mode=mode)) as envs:
        envs.reset(seed=0)
        first_episode = True
        compared = 0
        for action in steps:
            _, _, terminated, truncated, infos = envs.step(np.stack([action, action]))
            ended = terminated | truncated
            first_episode = first_episode and not ended.any()
            if first_episode:
                compared += 1
                expected = single.step(action)[4]
                for key, value in expected.items():
                    array = infos[key]
                    assert infos[f"_{key}"].all()
                    assert array.dtype == np.asarray(value).dtype, key
                    np.testing.assert_array_equal(array[0], value, err_msg=key)
            if ended.any() and mode == gym.vector.AutoresetMode.DISABLED:
                envs.reset(options={"reset_mask": ended})
        assert compared >= 2
