"""The cars' motion: drawn states against the process's own equations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from safe_wrappers.envs.traffic import (
    CAR_ACCELERATION_NOISE,
    CAR_MEAN_SPEED,
    CAR_SPEED_STD,
    CAR_TIME_CONSTANT_S,
    Traffic,
    noise_covariance,
    transition,
)

A = np.array([[0.0, 1.0], [0.0, -1.0 / CAR_TIME_CONSTANT_S]])
Q = np.diag([0.0, CAR_ACCELERATION_NOISE])
CARS = 4000


@given(time_s=st.floats(0.01, 20.0))
def test_a_step_is_van_loans(time_s):
    block = expm(np.block([[-A, Q], [np.zeros((2, 2)), A.T]]) * time_s)
    flow = block[2:, 2:].T
    np.testing.assert_allclose(transition(time_s), flow, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(noise_covariance(time_s), flow @ block[:2, 2:], rtol=1e-6, atol=1e-14)


def drawn(rng, step_s, steps, times, position, velocity, mean=CAR_MEAN_SPEED):
    """States of many cars at the times, shape (times, 2, CARS)."""
    traffic = Traffic(np.full(CARS, mean), step_s, steps)
    state = np.stack(np.broadcast_arrays(position, velocity, np.zeros(CARS))[:2])
    found, now = [], 0
    for time in times:
        while now < round(time / step_s):
            path = traffic.drive(rng, *state)
            state = path[-1]
            now += steps
        found.append(state)
    return np.array(found)


@pytest.mark.parametrize(("step_s", "steps", "mean"), [(0.01, 4, 1.0), (0.04, 1, -1.0), (0.5, 2, 1.0)])
def test_means_and_covariances_follow_the_moment_equations(step_s, steps, mean):
    """4,000 cars from one state, against the numerically integrated moments: every z-score within 4.5."""
    times, start = [1.0, 4.0, 10.0], np.array([-3.0, mean * 1.4])

    def rates(_, y):
        p = y[2:].reshape(2, 2)
        return [*(A @ y[:2] + [0.0, mean / CAR_TIME_CONSTANT_S]), *(A @ p + p @ A.T + Q).ravel()]

    moments = solve_ivp(rates, (0, 10.0), [*start, 0, 0, 0, 0], t_eval=times, rtol=1e-10, atol=1e-12).y.T
    states = drawn(np.random.default_rng(1), step_s, steps, times, *start, mean)
    for state, moment in zip(states, moments, strict=True):
        expected, covariance = moment[:2], moment[2:].reshape(2, 2)
        z_mean = (state.mean(axis=1) - expected) / np.sqrt(np.diag(covariance) / CARS)
        sample = np.cov(state)
        # Standard error of a normal sample's covariance entry: sqrt((P_ii P_jj + P_ij^2) / (n - 1)).
        variances = np.diag(covariance)
        error = np.sqrt((np.outer(variances, variances) + covariance**2) / (CARS - 1))
        assert np.abs(z_mean).max() < 4.5
        assert np.abs((sample - covariance) / error).max() < 4.5


def test_a_speed_stays_in_its_stationary_distribution_and_forgets():
    rng = np.random.default_rng(2)
    first = rng.normal(CAR_MEAN_SPEED, CAR_SPEED_STD, CARS)
    _, velocity = drawn(rng, 0.01, 4, [2.0], 0.0, first)[0]
    assert (velocity.var() / CAR_SPEED_STD**2 - 1.0) / np.sqrt(2.0 / CARS) == pytest.approx(0.0, abs=4.5)
    assert np.corrcoef(first, velocity)[0, 1] == pytest.approx(np.exp(-1.0), abs=4.5 / np.sqrt(CARS))


def test_drawing_several_steps_at_once_is_drawing_them_one_by_one():
    means = np.array([1.0, -1.0, 1.0])
    position, velocity = np.array([-3.0, 5.0, 0.0]), np.array([0.7, -1.2, 30.0])
    together = Traffic(means, 0.01, 4).drive(np.random.default_rng(3), position, velocity)
    assert together.shape == (4, 2, 3)
    rng, single = np.random.default_rng(3), Traffic(means, 0.01, 1)
    for state in together:
        position, velocity = single.drive(rng, position, velocity)[0]
        np.testing.assert_allclose(state, [position, velocity], rtol=1e-13)
    assert rng.bit_generator.state["state"] != np.random.default_rng(3).bit_generator.state["state"]
