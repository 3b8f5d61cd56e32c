"""Envs of a vector env that are simulated are decided as single ones are, in every autoreset mode."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

import safe_wrappers as sw
from safe_wrappers.constraints import PredictiveShield


def slow():
    return [
        PredictiveShield(
            lambda x: 2.0 - abs(x[2]), 5, backup=[lambda x: [-2.0 * np.sign(x[2])], "zero"], candidates=4
        )
    ]


def pendulum():
    return TimeLimit(gym.make("Pendulum-v1", max_episode_steps=-1), 12)


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")  # its motor is too weak for this h
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_it_decides_as_single_filters_do(mode):
    def plant():
        return sw.SimulatorPlant(check_steps=0)

    def filtered():
        return sw.CBFActionFilter(pendulum(), slow(), plant=plant())

    together = sw.VectorCBFActionFilter(
        SyncVectorEnv([pendulum] * 2, autoreset_mode=mode), slow(), plant=plant()
    )
    apart = SyncVectorEnv([filtered] * 2, autoreset_mode=mode)
    rng, changed = np.random.default_rng(0), 0
    for envs in (together, apart):
        envs.reset(seed=3)
    for step in range(40):
        actions = rng.uniform(-2.0, 2.0, (2, 1)).astype(np.float32)
        mine, theirs = together.step(actions), apart.step(actions)
        np.testing.assert_array_equal(mine[0], theirs[0])
        for key in ("cbf/margin", "cbf/intervened", "cbf/stage", "executed_action"):
            np.testing.assert_array_equal(mine[4][key], theirs[4][key], err_msg=f"{key} at step {step}")
        changed += int(mine[4]["cbf/intervened"].sum())
        if mode is AutoresetMode.DISABLED and mine[3].any():
            for envs in (together, apart):
                envs.reset(options={"reset_mask": mine[3]})
    assert changed > 5
