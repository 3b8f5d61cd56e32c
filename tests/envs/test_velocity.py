"""The velocity tasks: the standard env bit for bit, and a cost checked against displacements."""

import math
import warnings

import gymnasium as gym
import mujoco
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


@pytest.mark.parametrize("version", ["v5", "v4"])
@pytest.mark.parametrize("robot", PUBLISHED)
def test_all_but_the_cost_is_the_standard_env_bit_for_bit(robot, version):
    env = make(robot, version)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date")
        standard = gym.make(f"{robot}-{version}")
    assert env.observation_space == standard.observation_space
    assert env.action_space == standard.action_space
    assert env.metadata == standard.metadata
    assert env.spec.max_episode_steps == standard.spec.max_episode_steps == 1000
    ours, theirs = env.unwrapped, standard.unwrapped
    assert ours.speed_limit == PUBLISHED[robot]
    env.action_space.seed(3)
    for seed in (7, None):  # the later episode goes on with the same generator
        observation, info = env.reset(seed=seed)
        expected, info_0 = standard.reset(seed=seed)
        for _ in range(40):
            assert same(observation, expected)
            assert info.keys() - info_0.keys() == ADDED
            assert all(same(info[key], value) for key, value in info_0.items())
            assert all(type(info[key]) is float for key in ADDED)
            action = env.action_space.sample()
            observation, *outcome, info = env.step(action)
            expected, *outcome_0, info_0 = standard.step(action)
            assert all(map(same, outcome, outcome_0))
            velocity = (
                [info_0["x_velocity"], info_0["y_velocity"]] if robot in PLANAR else info_0["x_velocity"]
            )
            assert info["speed"] == (np.sqrt(np.square(velocity).sum()) if robot in PLANAR else velocity)
            if outcome[1]:
                break
    assert ours.np_random.bit_generator.state == theirs.np_random.bit_generator.state


def launch(env, x, y=0.0):
    """From the present pose, at rest but for the base, which moves at (x, y) m/s."""
    bare = env.unwrapped
    velocity = np.zeros(bare.model.nv)
    velocity[0] = x
    if y:  # only robots with a y joint are sent there
        velocity[1] = y
    bare.set_state(bare.data.qpos.copy(), velocity)


def judged_point(robot, bare):
    """Where a robot is in the plane, from joint positions alone: Ant's torso, Humanoid's centre of mass."""
    if robot != "Humanoid":
        return bare.data.qpos[:2].copy()
    data = mujoco.MjData(bare.model)
    data.qpos[:] = bare.data.qpos
    mujoco.mj_kinematics(bare.model, data)
    mujoco.mj_comPos(bare.model, data)
    return data.subtree_com[0, :2].copy()


@pytest.mark.parametrize(("robot", "version"), [*((robot, "v5") for robot in PUBLISHED), ("Ant", "v4")])
def test_the_cost_is_that_of_the_displacement(robot, version):
    env, limit, costs = make(robot, version), PUBLISHED[robot], []
    bare, planar = env.unwrapped, robot in PLANAR
    env.action_space.seed(5)
    for seed, (x, y) in enumerate([(2.5, 0.0), (0.3, 0.0), (-2.5, 0.0), (0.0, 2.5), (0.8, -0.9)]):
        env.reset(seed=seed)
        launch(env, x * limit, y * limit if robot in (*PLANAR, "Swimmer") else 0.0)
        for _ in range(6):
            before = judged_point(robot, bare)
            _, _, terminated, _, info = env.step(env.action_space.sample())
            way = judged_point(robot, bare) - before
            speed = (np.hypot(*way) if planar else way[0]) / bare.dt
            # In the plane Gymnasium reads the last trial of Runge and Kutta's, not the state that is reached.
            assert info["speed"] == pytest.approx(speed, abs={"Ant": 0.15, "Humanoid": 5e-3}.get(robot, 1e-6))
            assert info["cost"] == info["cost_substep"] == float(info["speed"] > limit)
            costs.append((np.sign(way[0]), info["cost"]))
            if terminated:
                break
    assert {(1.0, 0.0), (1.0, 1.0)} <= set(costs)
    assert ((-1.0, 1.0) in costs) == planar  # running backwards


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
