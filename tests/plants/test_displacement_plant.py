"""DisplacementPlant against gymnasium-robotics' Fetch envs themselves: their own step, to the last bit."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants import default_plant

gym.register_envs(pytest.importorskip("gymnasium_robotics"))

ENVS = ["FetchReach-v4", "FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4"]
every_env = pytest.mark.parametrize("env_id", ENVS)


def bound(env, **options):
    plant = sw.plants.DisplacementPlant(**options)
    plant.bind(env)
    return plant


def actions(seed, steps, down=0.3):
    """Random ones, corners held for a while, and dives into the table and whatever lies on it."""
    rng = np.random.default_rng(seed)
    held = np.ones(4)
    for k in range(steps):
        if k % 12 == 0:
            held = np.where(rng.random(4) < 0.5, -1.0, 1.0)
            held[2] = -1.0 if rng.random() < down else held[2]
        yield (rng.uniform(-1.0, 1.0, 4) if k % 3 == 2 else held).astype(np.float32)


def watched(raw):
    """Positions and velocities after every physics substep of the env's own next step."""
    seen = []

    def step(action):
        for _ in range(raw.n_substeps):
            mujoco.mj_step(raw.model, raw.data)
            seen.append((raw.data.qpos.copy(), raw.data.qvel.copy()))

    raw._mujoco_step = step
    return seen


def inputs(data):
    """What the env has set, and where MuJoCo has the bodies: what the next step starts from beside the state."""
    return [a.copy() for a in (data.mocap_pos, data.mocap_quat, data.ctrl, data.xpos[1:], data.xquat[1:])]


# Forecasts ----------------------------------------------------------------------------------------------------


@every_env
def test_every_substep_is_the_envs_own_to_the_last_bit(env_id):
    env = gym.make(env_id, max_episode_steps=35)
    raw, plant = env.unwrapped, bound(env)
    seen = watched(raw)
    over, episode = True, 0
    for k, action in enumerate(actions(0, 80)):
        if over:
            env.reset(seed=episode)
            episode += 1
        plant.observe()
        control = action.astype(np.float64)
        if k % 3 == 1:  # other questions between do not disturb it
            plant.pose(), plant.rollout(-control), plant.forward(), plant.braking()
        if k % 5 == 0:
            plant.rollout(control)
            expected = inputs(plant.data)
        forecast = plant.rollout(control, horizon=2)
        seen.clear()
        *_, over, _ = env.step(action)
        n = raw.n_substeps
        # Not the last one: the env closes the fingers after it.
        assert all(np.array_equal(forecast.qpos[i], seen[i][0]) for i in range(n - 1))
        assert all(np.array_equal(forecast.qvel[i], seen[i][1]) for i in range(n))
        assert np.array_equal(forecast.qpos[n - 1], raw.data.qpos)
        assert np.array_equal(forecast.published_frames[0][1:], raw.data.xpos[1:])
        if k % 5 == 0:
            assert all(np.array_equal(a, b) for a, b in zip(expected, inputs(raw.data), strict=True))


@every_env
def test_after_the_held_action_a_forecast_brakes_as_steps_of_zero_do(env_id):
    env = gym.make(env_id)
    plant, data = bound(env), env.unwrapped.data
    env.reset(seed=0)
    for action in actions(1, 6):
        env.step(action)
    plant.observe()
    action = np.array([1.0, -0.4, -0.2, 0.7], dtype=np.float32)
    forecast = plant.rollout(action.astype(np.float64), horizon=4)
    assert np.array_equal(plant.braking(), np.zeros(4))
    for hold in range(4):
        env.step(action if hold == 0 else np.zeros(4, np.float32))
        end = (hold + 1) * plant.substeps - 1
        assert np.array_equal(forecast.qpos[end], data.qpos) and np.array_equal(forecast.qvel[end], data.qvel)


# What it is not -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("constraint", [
    sw.constraints.Barrier(lambda x: 1.0 - x[0], alpha=1.0),
    sw.constraints.Clearance(
        [sw.constraints.Plane([0.0, 0.0, 0.45], [0.0, 0.0, 1.0])], braking=5.0, bodies=["robot0:gripper_link"]
    ),
    sw.constraints.ImpactSpeedLimit(["robot0:l_gripper_finger_link"], ["table0"], force_limit=50.0, stiffness=1e4),
    sw.constraints.TrackPermission("robot0:gripper_link", braking=1.0),
])  # fmt: skip
def test_constraints_that_need_accelerations_are_refused_when_the_filter_is_built(constraint):
    name = type(constraint).__name__
    with pytest.raises(UnsupportedEnvError, match=f"{name} needs the acceleration .* Workspace, Joint"):
        sw.CBFActionFilter(gym.make("FetchReach-v4"), [constraint])


@every_env
def test_it_is_what_a_fetch_env_gets_when_no_plant_is_named(env_id):
    assert type(default_plant(gym.make(env_id))) is sw.plants.DisplacementPlant
    assert type(default_plant(gym.make("Reacher-v5"))) is sw.MujocoPlant
