"""Envs that keep model and data elsewhere than in `.model` and `.data`, and envs that hold the one that steps them.

The oracle is the env's own step.
"""

from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw

PENDULUM = """
<mujoco><compiler autolimits="true"/><option timestep="0.005"/><worldbody>
  <body><joint name="swing" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1"/></body></worldbody>
  <actuator><motor joint="swing" ctrlrange="-2 2"/></actuator></mujoco>
"""


class Nested(gym.Env):
    """A pendulum whose model and data are two levels down, and which does not say how long a step lasts."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, most=2.0, scale=1.0):
        model = mujoco.MjModel.from_xml_string(PENDULUM)
        self.sim = SimpleNamespace(
            model=SimpleNamespace(_model=model), data=SimpleNamespace(_data=mujoco.MjData(model))
        )
        self.action_space, self.scale = gym.spaces.Box(-most, most, (1,), np.float64), scale

    def observed(self):
        return np.concatenate([self.sim.data._data.qpos, self.sim.data._data.qvel])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.sim.model._model, self.sim.data._data)
        self.sim.data._data.qpos[0] = self.np_random.uniform(-0.5, 0.5)
        return self.observed(), {}

    def step(self, action):
        self.sim.data._data.ctrl[:] = self.scale * action
        mujoco.mj_step(self.sim.model._model, self.sim.data._data, 4)
        return self.observed(), 0.0, False, False, {}


def nested_plant(**changed):
    known = {
        "model": lambda env: env.sim.model._model,
        "data": lambda env: env.sim.data._data,
        "control_dt": 0.02,
    }
    return sw.MujocoPlant(**known | changed)


@pytest.mark.parametrize("env", [Nested(), Nested(1.0, 2.0)], ids=["control", "mapped"])
def test_a_filter_keeps_a_limit_of_a_machine_two_levels_down(env):
    limit = sw.constraints.JointSpeedLimit(limit=2.0, margin=0.01)
    plant = nested_plant()
    filtered = sw.CBFActionFilter(env, [limit], plant=plant)
    assert plant.substeps == 4 and plant.control_dt == pytest.approx(0.02)
    assert (plant.action_map is None) == (env.scale == 1.0)
    filtered.reset(seed=0)
    rng, fastest, changed = np.random.default_rng(0), 0.0, 0
    for k in range(200):
        action = rng.uniform(-1.0, 1.0, 1) if k < 20 else env.action_space.high
        *_, info = filtered.step(action)
        fastest, changed = max(fastest, abs(env.sim.data._data.qvel[0])), changed + info["cbf/intervened"]
        assert np.array_equal(plant.rollout(info["executed_action"]).states[-1], env.observed())
        assert not info["cbf/infeasible"]
    assert 1.9 < fastest <= 2.0 and changed


class FromDmControl(gym.Env):
    """A user's own env around one of dm_control's."""

    def __init__(self, task, scale=1.0):
        suite = pytest.importorskip("dm_control.suite")
        self.inner, self.scale = suite.load(*task, task_kwargs={"random": 0}), scale
        self.physics, spec = self.inner.physics, self.inner.action_spec()
        self.action_space = gym.spaces.Box(spec.minimum / scale, spec.maximum / scale, spec.shape, np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.physics.get_state().size,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.inner.reset()
        return self.physics.get_state(), {}

    def step(self, action):
        self.inner.step(self.scale * action)
        return self.physics.get_state(), 0.0, False, False, {}


TASKS = [
    ("cartpole", "balance"),
    ("reacher", "easy"),
    ("walker", "walk"),
    ("finger", "spin"),
    ("humanoid", "run"),
]


def dm_plant(env, inner):
    plant = sw.MujocoPlant(
        model=lambda raw: inner(raw).physics.model.ptr,
        data=lambda raw: inner(raw).physics.data.ptr,
        control_dt=inner(env).control_timestep(),
    )
    plant.bind(env)
    return plant


def missed(env, plant, data, episodes=2, steps=100):
    """The largest difference between forecasts and steps."""
    rng, worst = np.random.default_rng(0), 0.0
    for episode in range(episodes):
        env.reset(seed=episode)
        plant.executed(None)
        for _ in range(steps):
            plant.observe()
            action = rng.uniform(env.action_space.low, env.action_space.high)
            end = plant.rollout(action).states[-1]
            env.step(action)
            worst = max(worst, float(np.abs(end - np.concatenate([data.qpos, data.qvel])).max()))
    return worst


@pytest.mark.parametrize("task", TASKS, ids="-".join)
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_step_of_a_dm_control_task_is_its_forecast(task, scale):
    env = FromDmControl(task, scale)
    plant = dm_plant(env, lambda raw: raw.inner)
    assert (plant.action_map is None) == (scale == 1.0)
    assert missed(env, plant, env.physics.data.ptr) <= 1e-9  # 0.0 with dm_control 1.0.44 and MuJoCo 3.11


@pytest.mark.parametrize(
    ("env_id", "substeps", "control_dt"), [("AntMaze_UMaze-v5", 5, 0.05), ("PointMaze_UMaze-v3", 1, 0.01)]
)
def test_the_hold_of_a_maze_is_the_inner_env_s(env_id, substeps, control_dt):
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    env = gym.make(env_id)
    plant = sw.MujocoPlant()
    plant.bind(env)
    assert plant.substeps == substeps
    assert plant.control_dt == pytest.approx(control_dt)
    env.reset(seed=0)
    before = env.unwrapped.data.time
    env.step(np.zeros(env.action_space.shape, env.action_space.dtype))
    assert env.unwrapped.data.time - before == pytest.approx(plant.control_dt)
