import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers  # noqa: F401 (registers its tasks)
from safe_wrappers.train.evaluation.step_log import coordinates_of


def test_joints_by_name_with_the_turns_taken_off():
    env = gym.make("Reacher-v5")
    observation, _ = env.reset(seed=0)
    names, read = coordinates_of(env)
    assert names == [
        "joint0, position (rad)",
        "joint1, position (rad)",
        "target_x, position (m)",
        "target_y, position (m)",
        "joint0, speed (rad/s)",
        "joint1, speed (rad/s)",
        "target_x, speed (m/s)",
        "target_y, speed (m/s)",
    ]
    qpos = np.array([0.3 + 4 * np.pi, 2.9, 0.1, -0.1])
    env.unwrapped.set_state(qpos, np.array([7.0, -3.0, 0.0, 0.0]))
    # joint1 has limits, so its angle stays as it is; joint0 has gone round twice.
    assert read(observation) == pytest.approx([0.3, 2.9, 0.1, -0.1, 7.0, -3.0, 0.0, 0.0])
    assert env.unwrapped.data.qpos == pytest.approx(qpos)  # looked at, not touched


def test_a_free_body_is_named_part_by_part():
    env = gym.make("Ant-v5")
    observation, _ = env.reset(seed=0)
    names, read = coordinates_of(env)
    values = dict(zip(names, read(observation), strict=True))
    data = env.unwrapped.data
    assert len(values) == len(data.qpos) + len(data.qvel)
    assert values["root, position 2"] == data.qpos[2]
    assert values["root, speed 0"] == data.qvel[0]
    assert values["root, speed 5"] == data.qvel[5]
    assert values["hip_1, position (rad)"] == data.qpos[7]


def test_a_task_seen_from_above_has_a_place():
    env = gym.make("SafePointGoal1-v0")
    observation, _ = env.reset(seed=0)
    names, read = coordinates_of(env)
    assert names == ["x (m)", "y (m)"]
    assert read(observation) == pytest.approx(env.unwrapped.agent_position[:2])


def test_other_envs_show_their_observation_or_nothing():
    env = gym.make("Pendulum-v1")
    observation, _ = env.reset(seed=0)
    names, read = coordinates_of(env)
    assert names == ["observation 0", "observation 1", "observation 2"]
    assert read(observation) == pytest.approx(observation)
    env = gym.make("FrozenLake-v1")
    observation, _ = env.reset(seed=0)
    names, read = coordinates_of(env)
    assert names == [] and read(observation).shape == (0,)
