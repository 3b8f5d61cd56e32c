"""How a covariance grows without measurements, against numerical integration and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import blind_covariance, double_integrator_covariance
from scipy.linalg import expm

from safe_wrappers.control.estimation import discretise

INTEGRATOR = np.array([[0.0, 1.0], [0.0, 0.0]])
seeds = st.integers(0, 10**6)
sizes = st.integers(1, 4)
times = st.floats(0.0, 5.0)


def random_system(seed, n):
    """A, Q (often singular) and P0 at random."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    root, start = rng.normal(size=(n, rng.integers(1, n + 1))), rng.normal(size=(n, n))
    return a, root @ root.T, start @ start.T


def quadrature(integrand, time):
    """From 0 to the time, by 30 nodes of Gauss and Legendre: for an entire function as good as exact."""
    nodes, weights = np.polynomial.legendre.leggauss(30)
    return 0.5 * time * np.tensordot(weights, integrand(0.5 * time * (nodes + 1.0)), axes=1)


# One step of time ------------------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(seeds, sizes, st.floats(0.01, 3.0))
def test_the_step_is_the_integral_by_quadrature(seed, n, time):
    a, q, _ = random_system(seed, n)
    expected = quadrature(lambda s: expm(s[:, None, None] * a) @ q @ expm(s[:, None, None] * a.T), time)
    transition, _, noise = discretise(a, q, time)
    np.testing.assert_allclose(transition, expm(a * time), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(noise, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())


def test_no_time_changes_nothing():
    a, q, start = random_system(3, 3)
    transition, _, noise = discretise(a, q, 0.0)
    assert np.array_equal(transition, np.eye(3)) and not noise.any()
    assert not discretise(a, q, 0.0, np.ones(3))[1].any()
    assert np.array_equal(blind_covariance(start, a, q, 0.0), start)


def test_a_stable_system_over_a_long_time_does_not_overflow():
    # exp(-A t) of the textbook block would be exp(1e5).
    for time in (1.0, 1000.0, 1e9):
        transition, _, noise = discretise([[-100.0]], [[3.0]], time)
        np.testing.assert_allclose(noise.item(), 3.0 / 200.0, rtol=1e-14)
    assert transition.item() == pytest.approx(0.0, abs=1e-300)


@settings(max_examples=20)
@given(seeds, sizes, st.floats(0.0, 3.0), st.booleans())
def test_a_drift_carries_as_integrated(seed, n, time, singular):
    a, *_ = random_system(seed, n)
    if singular:
        a[:, 0] = 0.0
    b = np.random.default_rng(seed).normal(size=n)
    expected = quadrature(lambda s: expm(s[:, None, None] * a) @ b, time)
    np.testing.assert_allclose(discretise(a, 0.0 * a, time, b)[1], expected, rtol=1e-9, atol=1e-11)


def test_a_drift_over_a_long_time_settles():
    for time, second in ((1.0, 2.0 * -np.expm1(-0.5)), (1e9, 2.0)):
        carried = discretise(np.diag([-100.0, -0.5]), np.eye(2), time, [3.0, 1.0])[1]
        np.testing.assert_allclose(carried, [0.03, second], rtol=1e-12)


# Blind ------------------------------------------------------------------------------------------------------------


@given(st.floats(0, 10), st.floats(-0.99, 0.99), st.floats(0, 10), st.floats(0, 10), st.floats(1e-3, 1e3))
def test_the_double_integrator_agrees_with_its_closed_form(p, correlation, v, intensity, time):
    start = np.array([[p, correlation * np.sqrt(p * v)], [correlation * np.sqrt(p * v), v]])
    closed = double_integrator_covariance(start, intensity, time)
    exact = blind_covariance(start, INTEGRATOR, np.diag([0.0, intensity]), time)
    deviation = np.sqrt(np.diag(closed))
    scale = np.outer(deviation, deviation)
    np.testing.assert_array_less(np.abs(closed - exact), 1e-10 * scale + 1e-300)
