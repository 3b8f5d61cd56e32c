"""The arm with elastic joints: MuJoCo against the two-mass model; its vibration is judged in test_substeps."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from flexible_joint import bias_of, inertia_of, resonances
from oracles import damping_ratios
from scipy.stats import kstest

MOTORS, SPRINGS = [0, 2], [1, 3]


@pytest.fixture
def bare():
    env = gym.make("FlexJointReach-v0").unwrapped
    env.reset(seed=0)
    return env


def test_mujoco_moves_as_the_two_mass_model(bare):
    arm, rng = bare.arm, np.random.default_rng(1)
    for _ in range(20):
        qpos, qvel = rng.normal(0.0, [1.5, 0.03] * 2), rng.normal(0.0, [4.0, 1.5] * 2)
        torque = rng.uniform([-3, -1], [3, 1])
        bare.data.qpos[:], bare.data.qvel[:], bare.data.ctrl[:] = qpos, qvel, torque
        mujoco.mj_forward(bare.model, bare.data)
        q, q_dot = qpos[MOTORS] + qpos[SPRINGS], qvel[MOTORS] + qvel[SPRINGS]
        carried = arm.stiffness * (qpos[MOTORS] - q) + arm.joint_damping * (qvel[MOTORS] - q_dot)
        motors = (torque - arm.motor_damping * qvel[MOTORS] - carried) / arm.rotor_inertia
        links = np.linalg.solve(inertia_of(arm, q), carried - bias_of(arm, q, q_dot))
        found = bare.data.qacc
        np.testing.assert_allclose(found[MOTORS], motors, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(found[MOTORS] + found[SPRINGS], links, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(bare.fingertip_position, bare.data.site("fingertip").xpos[:2], atol=1e-12)


def test_resonances_and_damping_are_those_declared(bare):
    arm, found = bare.arm, []
    for elbow in np.linspace(-math.pi, math.pi, 25):
        inertia = inertia_of(arm, np.array([0.3, elbow]))
        hertz = resonances(arm.stiffness, arm.rotor_inertia, inertia) / math.tau
        found += zip(hertz, damping_ratios(arm, inertia), strict=True)
    (low, least), (high, most) = np.min(found, axis=0), np.max(found, axis=0)
    assert 10.0 < low < 11.0 and 18.0 < high < 19.0
    assert 0.005 < least < 0.007 and 0.016 < most < 0.018


def test_observation_and_reward(bare):
    qpos, qvel = np.array([0.4, 0.01, 1.2, -0.02]), np.array([1.0, 0.3, -2.0, 0.4])
    bare.set_state(qpos, qvel)
    bare.place_target(np.array([0.1, -0.3]))
    observation, reward, terminated, truncated, info = bare.step(np.array([1.5, 9.0]))
    assert (terminated, truncated) == (False, False)
    qpos, qvel = bare.data.qpos.copy(), bare.data.qvel.copy()
    first = qpos[0] + qpos[1]
    tip = 0.3 * np.array([math.cos(first), math.sin(first)])
    tip += 0.3 * np.array([math.cos(first + qpos[2] + qpos[3]), math.sin(first + qpos[2] + qpos[3])])
    expected = np.concatenate(
        [np.cos(qpos[MOTORS]), np.sin(qpos[MOTORS]), qvel[MOTORS], -qpos[SPRINGS], -qvel[SPRINGS]]
    )
    np.testing.assert_allclose(observation[:10], expected)
    np.testing.assert_allclose(observation[10:], np.r_[0.1, -0.3, tip - [0.1, -0.3]])
    distance = math.dist(tip, (0.1, -0.3))
    assert info["tracking_error"] == pytest.approx(distance)
    assert info["reward_dist"] == pytest.approx(-distance)
    assert info["reward_ctrl"] == pytest.approx(-0.01 * (0.5**2 + 1.0))  # clipped at full torque
    assert reward == info["reward_dist"] + info["reward_ctrl"]


def test_a_start_is_at_rest_and_targets_fill_the_ring(bare):
    radii, angles = [], []
    for seed in range(1000):
        observation, info = bare.reset(seed=seed)
        assert info["vibration_energy"] == info["deflection"] == info["cost"] == info["reward_dist"] == 0.0
        np.testing.assert_array_equal(bare.data.qvel, 0.0)
        assert np.abs(bare.data.qpos[MOTORS] - [0.0, 1.5]).max() <= 0.1
        x, y = observation[10:12]
        radii.append(math.hypot(x, y))
        angles.append(math.atan2(y, x))
        assert info["tracking_error"] == pytest.approx(math.hypot(*observation[12:]))
    # Uniform by area: squared radii and angles are.
    assert kstest(np.square(radii), "uniform", (0.2**2, 0.55**2 - 0.2**2)).pvalue > 1e-3
    assert kstest(angles, "uniform", (-math.pi, math.tau)).pvalue > 1e-3
