"""The velocity tasks: the standard env bit for bit, and a cost checked against positions integrated apart."""

import copy
import math
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

from safe_wrappers.envs import SPEED_LIMITS
from safe_wrappers.envs.velocity import make_velocity_env
from safe_wrappers.errors import UnknownNameError
from safe_wrappers.plants.mujoco.contacts import evaluations

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

robots = pytest.mark.parametrize("robot", PUBLISHED)
versions = pytest.mark.parametrize("version", ["v5", "v4"])


def make(robot, version="v5", **kwargs):
    return gym.make(f"Safe{robot}Velocity-v0", version=version, **kwargs)


def make_standard(robot, version, **kwargs):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date")
        return gym.make(f"{robot}-{version}", **kwargs)


def launch(env, x, y=0.0):
    """From the present pose, at rest but for the base, which moves at (x, y) m/s."""
    bare = env.unwrapped
    velocity = np.zeros(bare.model.nv)
    velocity[0] = x
    if y:  # only robots with a y joint are sent there
        velocity[1] = y
    bare.set_state(bare.data.qpos.copy(), velocity)


def same(a, b):
    """Exactly the same: values and types, arrays too."""
    return type(a) is type(b) and np.array_equal(a, b)


@pytest.fixture(autouse=True)
def no_warnings():
    """A task that is asked for by its id warns of nothing, v4 neither."""
    with warnings.catch_warnings(action="error"):
        yield


@versions
@robots
def test_all_but_the_cost_is_the_standard_env_bit_for_bit(robot, version):
    env, standard = make(robot, version), make_standard(robot, version)
    assert env.observation_space == standard.observation_space
    assert env.action_space == standard.action_space
    assert env.metadata == standard.metadata
    assert env.spec.max_episode_steps == standard.spec.max_episode_steps == 1000
    ours, theirs = env.unwrapped, standard.unwrapped
    assert (ours.frame_skip, ours.dt) == (theirs.frame_skip, theirs.dt)
    env.action_space.seed(3)
    resets = 0
    done = True
    for step in range(120):
        if done or step == 60:
            seed = 7 if resets == 0 else None  # later episodes go on with the same generator
            resets += 1
            observation, info = env.reset(seed=seed)
            observation_0, info_0 = standard.reset(seed=seed)
        else:
            action = env.action_space.sample()
            observation, reward, terminated, truncated, info = env.step(action)
            observation_0, reward_0, terminated_0, truncated_0, info_0 = standard.step(action)
            assert same(reward, reward_0)
            assert same(terminated, terminated_0)
            assert same(truncated, truncated_0)
            done = terminated
        done = done and step != 0
        assert same(observation, observation_0)
        assert np.array_equal(ours.data.qpos, theirs.data.qpos)
        assert np.array_equal(ours.data.qvel, theirs.data.qvel)
        assert info.keys() - info_0.keys() == ADDED
        assert all(same(info[key], value) for key, value in info_0.items())
        assert all(type(info[key]) is float for key in ADDED)
    assert resets >= 2
    assert env.unwrapped.np_random.bit_generator.state == theirs.np_random.bit_generator.state


def test_the_limits_are_the_published_ones():
    assert SPEED_LIMITS == PUBLISHED
    assert all(f"Safe{robot}Velocity-v0" in gym.registry for robot in PUBLISHED)
    for robot, limit in PUBLISHED.items():
        for version in ("v5", "v4"):
            assert make(robot, version).unwrapped.speed_limit == limit


def judged_point(robot, model, qpos):
    """Where a robot is in the plane, from joint positions alone."""
    if robot not in PLANAR:
        return qpos[:1].copy()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    if robot == "Ant":
        return data.body("torso").xpos[:2].copy()
    mujoco.mj_comPos(model, data)
    return data.subtree_com[0, :2].copy()


def last_trial(model, data):
    """Joint positions of the last of the four trial states of one Runge-Kutta step."""
    trials = []
    evaluations(model, copy.copy(data), lambda trial, _: trials.append(trial.qpos.copy()))
    assert len(trials) == 4
    return trials[-1]


def integrate(robot, model, start, control, frame_skip):
    """The control step again on other data; the judged point as published at its end."""
    data = copy.copy(start)
    data.ctrl[:] = control
    for _ in range(frame_skip - 1):
        mujoco.mj_step(model, data)
    if robot in PLANAR:  # Gymnasium reads where MuJoCo looked last, which is not the state it then reached
        return judged_point(robot, model, last_trial(model, data))
    mujoco.mj_step(model, data)
    return judged_point(robot, model, data.qpos)


@versions
@robots
def test_the_cost_is_that_of_the_positions(robot, version):
    env = make(robot, version)
    bare, limit = env.unwrapped, PUBLISHED[robot]
    model = copy.copy(bare.model)
    env.action_space.seed(5)
    costs = []
    for seed, (x, y) in enumerate([(2.5, 0.0), (0.3, 0.0), (-2.5, 0.0), (0.0, 2.5), (0.8, -0.9)]):
        env.reset(seed=seed)
        launch(env, x * limit, y * limit if robot in (*PLANAR, "Swimmer") else 0.0)
        point = judged_point(robot, model, bare.data.qpos)
        for _ in range(6):
            action = env.action_space.sample()
            after = integrate(robot, model, bare.data, action, bare.frame_skip)
            _, _, terminated, _, info = env.step(action)
            displacement = after - point
            travelled = np.linalg.norm(displacement) if robot in PLANAR else displacement[0]
            speed = travelled / (bare.frame_skip * model.opt.timestep)
            assert info["speed"] == pytest.approx(speed, abs=1e-6)
            assert info["cost"] == (1.0 if speed > limit else 0.0)
            assert info["cost_substep"] == info["cost"]
            costs.append(info["cost"])
            point = after
            if terminated:
                break
    assert {0.0, 1.0} == set(costs)


@versions
@robots
def test_only_planar_robots_pay_for_running_backwards(robot, version):
    env = make(robot, version)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    limit = PUBLISHED[robot]
    costs = {}
    for way in (1.0, -1.0):
        env.reset(seed=0)
        launch(env, 2.0 * way * limit)
        info = env.step(still)[4]
        costs[way] = info["cost"]
        assert abs(info["speed"]) > limit
        assert info["speed"] > 0 or robot not in PLANAR
    assert costs == {1.0: 1.0, -1.0: 1.0 if robot in PLANAR else 0.0}


@pytest.mark.parametrize("robot", ["Hopper", "Ant"])
def test_the_limit_itself_costs_nothing(robot):
    env = make(robot)

    def first_step():
        env.reset(seed=4)
        launch(env, 1.0)
        return env.step(np.zeros(env.action_space.shape, dtype=np.float32))[4]

    speed = first_step()["speed"]
    env.unwrapped.speed_limit = speed
    assert first_step()["cost"] == 0.0
    env.unwrapped.speed_limit = math.nextafter(speed, -math.inf)
    assert first_step()["cost"] == 1.0


def test_a_speed_that_is_not_a_number_costs(monkeypatch):
    def broken(self, action):
        return np.zeros(17), math.nan, False, False, {"x_velocity": np.float64(math.nan)}

    env = make("HalfCheetah").unwrapped
    env.reset(seed=0)
    monkeypatch.setattr(HalfCheetahEnv, "step", broken)
    assert env.step(np.zeros(6))[4]["cost"] == 1.0


@pytest.mark.parametrize("version", ["v3", "V5", "", 4, None])
def test_an_unknown_version_is_refused_with_the_options(version):
    with pytest.raises(UnknownNameError, match="version must be one of 'v5', 'v4'; got"):
        make("Ant", version)


def test_an_unknown_robot_is_refused_with_the_options():
    with pytest.raises(UnknownNameError, match=r"'HalfCheetah', .*'Humanoid'; got 'Reacher'"):
        make_velocity_env("Reacher")
