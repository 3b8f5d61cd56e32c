"""PredictiveShield on MuJoCo envs, against every physics substep that MuJoCo itself makes of what was executed."""

import copy
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

import safe_wrappers as sw
from safe_wrappers.constraints import PredictiveShield

LIMIT = 15.0  # rad/s of every joint


def against(speeds):
    return np.clip(-0.1 * speeds, -1.0, 1.0)


SEES = {
    "observation": (lambda x: LIMIT - np.abs(x[11:17]).max(), lambda x: against(x[11:17])),
    "env": (lambda env: LIMIT - np.abs(env.data.qvel[3:]).max(), lambda env: against(env.data.qvel[3:])),
    "view": (
        lambda view: LIMIT - np.abs(view.observation[11:17]).max(),
        lambda view: against(view.env.data.qvel[3:]),
    ),
}


def shielded(env, sees="observation", h=None):
    usual, backup = SEES[sees]
    shield = PredictiveShield(h or usual, 4, backup=backup, candidates=6, sees=sees)
    return sw.CBFActionFilter(env, [shield], plant=sw.SimulatorPlant(check_steps=20))


def played(env, steps):
    """Least h at a substep and at the end, and the flags, of each step of a driver who reverses the motors."""
    raw, rng = env.unwrapped, np.random.default_rng(0)
    model = copy.copy(raw.model)
    data = mujoco.MjData(model)
    env.reset(seed=0)
    for step in range(steps):
        if step % 4 == 0:
            action = rng.choice([-1.0, 1.0], 6).astype(np.float32)
        mujoco.mj_copyData(data, model, raw.data)
        info = env.step(action)[4]
        data.ctrl[:] = info["executed_action"]
        left = []
        for _ in range(raw.frame_skip):
            mujoco.mj_step(model, data)
            left.append(LIMIT - np.abs(data.qvel[3:]).max())
        yield min(left), left[-1], info


@pytest.mark.parametrize("sees", SEES)
def test_no_substep_is_violated_without_a_flag(sees):
    changed = 0
    for least, _, info in played(shielded(gym.make("HalfCheetah-v5"), sees), 60):
        flagged = info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"]
        assert least >= 0.0 or flagged
        assert not info["cbf/mismatch"]  # looking at substeps changes nothing, bit for bit
        changed += info["cbf/intervened"]
    assert changed > 10


class Sensed(HalfCheetahEnv):
    """What it sees is noisy."""

    def _get_obs(self):
        return super()._get_obs() + 1e-3 * self.np_random.standard_normal(17)


class Counting(HalfCheetahEnv):
    """It counts how often it was seen, and that changes what it does."""

    seen = 0

    def _get_obs(self):
        self.seen += 1
        return super()._get_obs() + 1e-6 * self.seen


class Reporting(gym.Wrapper):
    """Its resets report as its steps do."""

    def reset(self, **options):
        observation, info = self.env.reset(**options)
        return observation, info | {"x_position": 0.0}


UNSEEN = {
    "a wrapper inside the filter changes the observation": lambda: (
        gym.wrappers.TransformObservation(gym.make("HalfCheetah-v5"), lambda x: 0.5 * x, None),
        "observation",
        None,
    ),
    "not the same twice": lambda: (Sensed(), "observation", None),
    "changes what it does|not the same twice": lambda: (Counting(), "view", None),
    "h reads 'x_position' of info": lambda: (
        Reporting(gym.make("HalfCheetah-v5")),
        "view",
        lambda view: 9.0 - view.info["x_position"],
    ),
}


@pytest.mark.parametrize("why", UNSEEN)
def test_where_substeps_cannot_be_judged_it_says_so_once_and_goes_on_as_it_was(why):
    env, sees, h = UNSEEN[why]()
    env = shielded(env, sees, h)
    env.reset(seed=0)
    with pytest.warns(
        UserWarning, match=f"ends of control steps alone.*({why}).*5 physics substeps.*JointSpeedLimit"
    ):
        info = env.step(np.zeros(6, np.float32))[4]
    assert not info["cbf/mismatch"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not env.step(np.zeros(6, np.float32))[4]["cbf/mismatch"]


def test_envs_that_step_in_a_way_of_their_own_are_told_at_construction():
    shield = PredictiveShield(lambda x: 1.0, 2, sees="env")
    plant = sw.SimulatorPlant(check_steps=5)
    with pytest.warns(
        UserWarning, match=r"does not step MuJoCo as Gymnasium's MujocoEnv.*10 physics substeps"
    ):
        sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [shield], plant=plant)
    logged = sw.IdentifiedPlant(sw.plants.log_steps(gym.make("Reacher-v5"), episodes=20, max_steps=20))
    with pytest.warns(UserWarning, match=r"logs are of control steps: each has 2 physics substeps"):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [PredictiveShield(lambda x: 1.0, 2)], plant=logged)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cost = PredictiveShield("cost", 2)  # judged by the env, at every substep of its own
        plant = sw.SimulatorPlant(check_steps=5)
        sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [cost], plant=plant)
        for env_id in ("HalfCheetah-v5", "Pendulum-v1"):
            sw.CBFActionFilter(gym.make(env_id), [PredictiveShield(lambda x: 1.0, 2)])
