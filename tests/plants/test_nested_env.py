"""Envs that hold the env which steps the physics: gymnasium-robotics' mazes."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw

robotics = pytest.importorskip("gymnasium_robotics")
gym.register_envs(robotics)


@pytest.mark.parametrize(
    ("env_id", "substeps", "control_dt"), [("AntMaze_UMaze-v5", 5, 0.05), ("PointMaze_UMaze-v3", 1, 0.01)]
)
def test_the_hold_is_the_inner_env_s(env_id, substeps, control_dt):
    env = gym.make(env_id)
    plant = sw.MujocoPlant()
    plant.bind(env)
    assert plant.substeps == substeps
    assert plant.control_dt == pytest.approx(control_dt)
    env.reset(seed=0)
    before = env.unwrapped.data.time
    env.step(np.zeros(env.action_space.shape, env.action_space.dtype))
    assert env.unwrapped.data.time - before == pytest.approx(plant.control_dt)
