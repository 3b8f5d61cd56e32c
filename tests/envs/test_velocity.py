"""The velocity tasks: the standard env bit for bit, and a cost of the speed that it publishes."""

import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

from safe_wrappers.envs.velocity import make_velocity_env
from safe_wrappers.errors import UnknownNameError

PUBLISHED = {
    "HalfCheetah": 3.2096,
    "Hopper": 0.7402,
    "Walker2d": 2.3415,
    "Swimmer": 0.2282,
    "Ant": 2.6222,
    "Humanoid": 1.4149,
}
PLANAR = ("Ant", "Humanoid")
ADDED = {"speed", "cost", "cost_substep"}


def make(robot, version="v5", **kwargs):
    return gym.make(f"Safe{robot}Velocity-v0", version=version, **kwargs)


def same(a, b):
    """Exactly the same: values and types, arrays too."""
    return type(a) is type(b) and np.array_equal(a, b)


@pytest.fixture(autouse=True)
def no_warnings():
    """A task that is asked for by its id warns of nothing, v4 neither."""
    with warnings.catch_warnings(action="error"):
        yield


def launch(env, x, y=0.0):
    """From the present pose, at rest but for the base, which moves at (x, y) m/s."""
    bare = env.unwrapped
    velocity = np.zeros(bare.model.nv)
    velocity[:2] = x, y
    bare.set_state(bare.data.qpos.copy(), velocity)


@pytest.mark.parametrize("version", ["v5", "v4"])
@pytest.mark.parametrize("robot", PUBLISHED)
def test_all_but_the_cost_is_the_standard_env_bit_for_bit(robot, version):
    env, limit, planar, costs = make(robot, version), PUBLISHED[robot], robot in PLANAR, set()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date")
        standard = gym.make(f"{robot}-{version}")
    assert env.observation_space == standard.observation_space
    assert env.action_space == standard.action_space
    assert env.metadata == standard.metadata
    assert env.spec.max_episode_steps == standard.spec.max_episode_steps == 1000
    ours, theirs = env.unwrapped, standard.unwrapped
    assert ours.speed_limit == limit
    env.action_space.seed(3)
    # The later episodes go on with the same generator; at times at more than the limit, forwards and back.
    for seed, speed, steps in (
        (7, 0.0, 40),
        (None, 2.5, 6),
        (None, 0.3, 6),
        (None, -2.5, 6),
        (None, 0.0, 40),
    ):
        observation, info = env.reset(seed=seed)
        expected, info_0 = standard.reset(seed=seed)
        assert info["speed"] == info["cost"] == info["cost_substep"] == 0.0
        if speed:
            launch(env, speed * limit)
            launch(standard, speed * limit)
            observation = expected
        for _ in range(steps):
            assert same(observation, expected)
            assert info.keys() - info_0.keys() == ADDED
            assert all(same(info[key], value) for key, value in info_0.items())
            assert all(type(info[key]) is float for key in ADDED)
            action = env.action_space.sample()
            observation, *outcome, info = env.step(action)
            expected, *outcome_0, info_0 = standard.step(action)
            assert all(map(same, outcome, outcome_0))
            along, across = info_0["x_velocity"], info_0.get("y_velocity", 0.0)
            assert info["speed"] == (np.sqrt(np.square([along, across]).sum()) if planar else along)
            assert info["cost"] == info["cost_substep"] == float(info["speed"] > limit)
            costs.add((bool(along > 0.0), info["cost"]))
            if outcome[1]:
                break
    assert ours.np_random.bit_generator.state == theirs.np_random.bit_generator.state
    assert {(True, 0.0), (True, 1.0)} <= costs and ((False, 1.0) in costs) == planar


def test_the_limit_itself_costs_nothing_and_a_speed_that_is_not_a_number_does(monkeypatch):
    env = make("Hopper")

    def first_step():
        env.reset(seed=4)
        launch(env, 1.0)
        return env.step(np.zeros(env.action_space.shape, dtype=np.float32))[4]

    speed = first_step()["speed"]
    for limit, cost in ((speed, 0.0), (math.nextafter(speed, -math.inf), 1.0)):
        env.unwrapped.speed_limit = limit
        assert first_step()["cost"] == cost

    def broken(self, action):
        return np.zeros(17), math.nan, False, False, {"x_velocity": np.float64(math.nan)}

    env = make("HalfCheetah").unwrapped
    env.reset(seed=0)
    monkeypatch.setattr(HalfCheetahEnv, "step", broken)
    assert env.step(np.zeros(6))[4]["cost"] == 1.0


def test_unknown_robots_and_versions_are_refused_with_the_options():
    for version in ("v3", 4, None):
        with pytest.raises(UnknownNameError, match="version must be one of 'v5', 'v4'; got"):
            make("Ant", version)
    with pytest.raises(UnknownNameError, match=r"'HalfCheetah', .*'Humanoid'; got 'Reacher'"):
        make_velocity_env("Reacher")
