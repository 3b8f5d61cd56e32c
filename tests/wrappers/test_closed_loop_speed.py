"""A robot that runs at its speed limit, driven by whatever hypothesis finds: no violation that nothing flags."""

import functools

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.envs import SPEED_LIMITS

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")


@functools.cache
def recipe(robot):
    """The task as it is published, in the filter that protect puts around it; made once."""
    return sw.protect(gym.make(f"Safe{robot}Velocity-v0", disable_env_checker=True))


def flagged(info):
    return info["cbf/infeasible"] or info["cbf/fallback"]


pulses = st.lists(
    st.tuples(
        st.integers(1, 8),  # control steps that it is held for
        st.lists(st.sampled_from([-1.0, -0.3, 0.0, 0.5, 1.0]), min_size=6, max_size=6),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=25)
@given(seed=st.integers(0, 50), speed=st.floats(0.0, 3.1), controls=pulses)
def test_no_control_sequence_costs_without_a_flag(seed, speed, controls):
    env = recipe("HalfCheetah")
    env.reset(seed=seed)
    env.unwrapped.data.qvel[0] = speed
    for held, control in controls:
        for _ in range(held):
            info = env.step(np.array(control, np.float32))[4]
            assert info["cost"] == 0.0 or flagged(info)
            assert info["speed"] <= 3.2096 or flagged(info)
            assert (np.abs(info["executed_action"]) <= 1.0).all()
            if not info["cbf/refused"].any():
                np.testing.assert_array_equal(info["executed_action"], np.array(control, np.float32))


def test_the_drivers_above_would_be_too_fast():
    env = gym.make("SafeHalfCheetahVelocity-v0")
    rng, cost, slow = np.random.default_rng(0), 0.0, 0
    for seed in range(6):
        env.reset(seed=seed)
        env.unwrapped.data.qvel[0] = 3.0
        for _ in range(6):
            info = env.step(rng.choice([-1.0, 1.0], 6).astype(np.float32))[4]
            cost += info["cost"]
            slow += info["speed"] > 0.7
    assert cost > 5 and slow > 20


# Every robot, by a driver that looks ahead ---------------------------------------------------------------------


def fastest(raw, scratch, rng):
    """Of some full controls the one that carries the robot farthest along x in two control steps."""
    high = raw.action_space.high
    tried = [high * rng.choice([-1.0, 1.0], high.shape) for _ in range(4)]

    def reached(control):
        mujoco.mj_copyData(scratch, raw.model, raw.data)
        scratch.ctrl[:] = control
        mujoco.mj_step(raw.model, scratch, nstep=2 * raw.frame_skip)
        return scratch.qpos[0]

    return max(tried, key=reached).astype(np.float32)


def drive(robot, episodes, steps):
    """Throw the robot at its limit and push on; returns steps, refused, infeasible and costs."""
    env = recipe(robot)
    raw = env.unwrapped
    scratch, rng = mujoco.MjData(raw.model), np.random.default_rng(0)
    seen = np.zeros(4, dtype=int)
    for seed in range(episodes):
        env.reset(seed=seed)
        raw.data.qvel[0] = rng.uniform(0.85, 1.0) * raw.speed_limit
        for _ in range(steps):
            action = fastest(raw, scratch, rng)
            *_, terminated, _, info = env.step(action)
            assert info["cost"] == 0.0 or flagged(info)
            seen += [1, bool(info["cbf/refused"].any()), info["cbf/infeasible"], bool(info["cost"])]
            if terminated:
                break
    return seen


@pytest.mark.parametrize("robot", SPEED_LIMITS)
def test_no_robot_pays_without_a_flag(robot):
    drive(robot, episodes=3, steps=12)
