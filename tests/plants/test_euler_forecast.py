"""Forecasts that brake by Euler steps, sketches, and forecasts in plain Python."""

import copy

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw

EULER = int(mujoco.mjtIntegrator.mjINT_EULER)


def started(env_id, seed=0):
    """An env after some steps, and its plant."""
    env = gym.make(env_id)
    env.reset(seed=seed)
    for action in np.random.default_rng(seed).uniform(-0.5, 0.5, (8, *env.action_space.shape)):
        env.step(action.astype(env.action_space.dtype))
    plant = sw.MujocoPlant()
    plant.bind(env)
    plant.observe()
    return env.unwrapped, plant


def by_hand(raw, plant, control, own_holds, holds):
    """States after each substep; from `own_holds` on by Euler steps of a model of its own."""
    euler, data = copy.copy(raw.model), mujoco.MjData(raw.model)
    euler.opt.integrator = EULER
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = raw.data.qpos, raw.data.qvel, raw.data.qacc_warmstart
    path = []
    for hold in range(holds):
        data.ctrl[:] = plant._recorder.braking(data) if hold else control
        for _ in range(plant.substeps):
            mujoco.mj_step(raw.model if hold < own_holds else euler, data)
            path.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(path)


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Ant-v5", "Swimmer-v5", "Reacher-v5", "HalfCheetah-v5"])
def test_the_look_ahead_and_a_sketch_are_euler_steps(env_id):
    raw, plant = started(env_id)
    control = 0.8 * plant.upper
    forecast, own = plant.rollout(control, 3, euler=True), plant.rollout(control, 3)
    np.testing.assert_array_equal(forecast.states, by_hand(raw, plant, control, 1, 3))
    np.testing.assert_array_equal(own.states, by_hand(raw, plant, control, 3, 3))
    np.testing.assert_array_equal(plant.sketch(control, 2).states, by_hand(raw, plant, control, 0, 2))
    assert plant.model.opt.integrator == raw.model.opt.integrator


def test_poses_published_by_euler_steps_do_not_lag():
    _, plant = started("Ant-v5")
    forecast = plant.rollout(0.5 * plant.upper, 3, euler=True)
    ends = forecast.poses(plant.substeps)
    np.testing.assert_array_equal(forecast.published_frames[1:], ends.frames[1:])
    np.testing.assert_array_equal(forecast.published_centres[1:], ends.centres[1:])
    # As after Runge-Kutta steps, whose last stage is near the end.
    own = plant.rollout(0.5 * plant.upper, 3)
    ends = own.poses(plant.substeps)
    moved = np.abs(np.diff(own.qpos, axis=0)).max()
    assert np.abs(own.published_frames - ends.frames).max() < 0.1 * moved
