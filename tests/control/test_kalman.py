"""The sampled filter: against Bayes' rule written out, python-control, and its own claims in Monte-Carlo runs."""

import control as ct
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from safe_wrappers.control.estimation import discretise, predict, update

INTEGRATOR = np.array([[0.0, 1.0], [0.0, 0.0]])
seeds = st.integers(0, 10**6)


def covariance(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2)


# One update -------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(1, 4), st.integers(1, 3))
def test_an_update_is_bayes_rule_on_the_joint_normal(seed, n, m):
    rng = np.random.default_rng(seed)
    cov, r, c = covariance(rng, n), covariance(rng, m) + 0.1 * np.eye(m), rng.normal(size=(m, n))
    mean, measured = rng.normal(size=n), rng.normal(size=m)
    # Condition (x, y) on y.
    cross, marginal = cov @ c.T, c @ cov @ c.T + r
    new_mean, new_cov = update(mean, cov, measured, c, r)
    np.testing.assert_allclose(
        new_mean, mean + cross @ np.linalg.solve(marginal, measured - c @ mean), rtol=1e-8, atol=1e-8
    )
    expected = cov - cross @ np.linalg.solve(marginal, cross.T)
    np.testing.assert_allclose(new_cov, expected, rtol=1e-7, atol=1e-9 * np.abs(cov).max())


@given(seeds, st.integers(1, 4), st.floats(-8, 8))
def test_the_covariance_stays_symmetric_and_semidefinite(seed, n, decades):
    rng = np.random.default_rng(seed)
    cov, c = covariance(rng, n), rng.normal(size=(1, n))
    for _ in range(20):
        cov = update(np.zeros(n), cov, np.zeros(1), c, np.array([[10.0**decades]]))[1]
        assert np.array_equal(cov, cov.T)
        assert np.linalg.eigvalsh(cov).min() >= -1e-13 * np.abs(cov).max()
        _, cov = predict(np.zeros(n), cov, np.eye(n) + 0.1 * rng.normal(size=(n, n)), 1e-9 * np.eye(n))
        assert np.array_equal(cov, cov.T)


# Against others ---------------------------------------------------------------------------------------------------


def test_the_steady_filter_is_python_control_s():
    step = discretise(INTEGRATOR, np.diag([0.0, 0.4]), 0.1)[::2]
    c, r = np.array([[1.0, 0.0]]), np.array([[0.05]])
    _, predicted, _ = ct.dlqe(step[0], np.eye(2), c, step[1], r)
    mean, cov = np.zeros(2), np.eye(2)
    for _ in range(500):
        mean, cov = predict(mean, update(mean, cov, np.zeros(1), c, r)[1], *step)
    np.testing.assert_allclose(cov, predicted, rtol=1e-9)


def test_ever_faster_sampling_becomes_the_filter_in_continuous_time():
    start, q, c, r = np.diag([0.5, 0.2]), np.diag([0.0, 0.4]), np.array([[1.0, 0.0]]), np.array([[0.05]])

    def riccati(_, flat):
        p = flat.reshape(2, 2)
        return (INTEGRATOR @ p + p @ INTEGRATOR.T + q - p @ c.T @ np.linalg.inv(r) @ c @ p).ravel()

    exact = solve_ivp(riccati, (0.0, 1.0), start.ravel(), rtol=1e-11, atol=1e-13).y[:, -1].reshape(2, 2)
    errors = []
    for steps in (1000, 2000):
        step, cov, mean = discretise(INTEGRATOR, q, 1.0 / steps)[::2], start, np.zeros(2)
        for _ in range(steps):
            mean, cov = predict(mean, cov, *step)
            cov = update(mean, cov, np.zeros(1), c, r * steps)[1]
        errors.append(np.abs(cov - exact).max() / np.abs(exact).max())
    assert errors[0] < 5e-3 and errors[1] == pytest.approx(errors[0] / 2, rel=0.05)
