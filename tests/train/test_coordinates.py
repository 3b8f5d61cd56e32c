import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import safe_wrappers  # noqa: F401 (registers its tasks)
from safe_wrappers.train.evaluation.coordinates import CoordinateReader


def test_joints_by_name_with_the_turns_taken_off():
    env = gym.make("Reacher-v5")
    observation, _ = env.reset(seed=0)
    reader = CoordinateReader(env)
    assert reader.names == (
        "joint0, angle (rad)",
        "joint1, angle (rad)",
        "target_x, position (m)",
        "target_y, position (m)",
        "joint0, speed (rad/s)",
        "joint1, speed (rad/s)",
        "target_x, speed (m/s)",
        "target_y, speed (m/s)",
    )
    qpos = np.array([0.3 + 4 * np.pi, 2.9, 0.1, -0.1])
    env.unwrapped.set_state(qpos, np.array([7.0, -3.0, 0.0, 0.0]))
    # joint1 has limits, so its angle stays as it is; joint0 has gone round twice.
    assert reader.read(observation) == pytest.approx([0.3, 2.9, 0.1, -0.1, 7.0, -3.0, 0.0, 0.0])
    assert env.unwrapped.data.qpos == pytest.approx(qpos)  # looked at, not touched


def test_a_free_body_is_named_part_by_part():
    env = gym.make("Ant-v5")
    observation, _ = env.reset(seed=0)
    reader = CoordinateReader(env)
    values = dict(zip(reader.names, reader.read(observation), strict=True))
    data = env.unwrapped.data
    assert len(values) == len(data.qpos) + len(data.qvel)
    assert values["root, z (m)"] == data.qpos[2]
    assert values["root, vx (m/s)"] == data.qvel[0]
    assert values["root, wz (rad/s)"] == data.qvel[5]
    assert values["hip_1, angle (rad)"] == data.qpos[7]


@settings(max_examples=25)
@given(
    heading=st.floats(-3.1, 3.1),
    ahead=st.floats(0.25, 0.6),
    left=st.floats(-0.3, 0.3),
    place=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)
def test_the_nearest_hazard_is_seen_from_the_robot(heading, ahead, left, place):
    # Complex numbers turn for us: what is `ahead + left i` for the robot lies turned by its heading in the world.
    hazard = complex(*place) + complex(ahead, left) * np.exp(1j * heading)
    env = _POINT
    layout = {
        "agent": [*place, heading],
        "goal": [2.0, 2.0],
        "hazards": [[9.0, 9.0], [hazard.real, hazard.imag]],
        "vases": [],
    }
    observation, _ = env.reset(seed=0, options={"layout": layout})
    reader = CoordinateReader(env)
    values = dict(zip(reader.names, reader.read(observation), strict=True))
    assert values["nearest hazard, ahead (m)"] == pytest.approx(ahead, abs=1e-9)
    assert values["nearest hazard, to the left (m)"] == pytest.approx(left, abs=1e-9)
    assert (values["x (m)"], values["y (m)"]) == pytest.approx(place)
    assert np.isnan(values["nearest vase, ahead (m)"])  # there is none


_POINT = gym.make("SafePointGoal1-v0")


def test_speed_is_the_way_of_the_last_step():
    env = gym.make("SafePointGoal0-v0")
    observation, _ = env.reset(seed=0)
    reader = CoordinateReader(env)
    places, speeds = [], []
    for _ in range(5):
        values = dict(zip(reader.names, reader.read(observation), strict=True))
        places.append((values["x (m)"], values["y (m)"]))
        speeds.append(values["speed (m/s)"])
        observation = env.step(np.array([1.0, 0.3], np.float32))[0]
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert speeds[0] == 0.0
    assert speeds[1:] == pytest.approx(ways / env.unwrapped.dt)
    assert ways[-1] > 0


def test_other_envs_show_their_observation_or_nothing():
    env = gym.make("Pendulum-v1")
    observation, _ = env.reset(seed=0)
    reader = CoordinateReader(env)
    assert reader.names == ("observation 0", "observation 1", "observation 2")
    assert reader.read(observation) == pytest.approx(observation)
    env = gym.make("FrozenLake-v1")
    observation, _ = env.reset(seed=0)
    assert CoordinateReader(env).names == ()
    assert CoordinateReader(env).read(observation).shape == (0,)
