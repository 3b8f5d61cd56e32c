"""How long an estimate may be relied on unseen: against closed forms and a fine grid of exact covariances."""

import math
import time

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles import blind_covariance, double_integrator_covariance
from scipy.optimize import brentq

from safe_wrappers.control.estimation.covariance import blind_time
from safe_wrappers.errors import ConfigurationError

INTEGRATOR = np.array([[0.0, 1.0], [0.0, 0.0]])
POSITION = np.array([1.0, 0.0])


def deviation(start, a, q, direction, t):
    rows = np.atleast_2d(direction)
    grown = blind_covariance(start, a, q, t)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(rows @ grown @ rows.T)[..., -1], 0.0))


@given(st.floats(1e-3, 0.2), st.floats(-0.95, 0.95), st.floats(0, 2), st.floats(1e-3, 2), st.floats(0.7, 3))
def test_the_double_integrator_crosses_where_its_closed_form_does(p, correlation, v, intensity, tolerance):
    start = np.array([[p**2, correlation * p * v], [correlation * p * v, v**2]])

    def excess(t):
        return 3.0 * math.sqrt(double_integrator_covariance(start, intensity, t)[0, 0]) - tolerance

    # From below the tolerance the cubic crosses it once: it falls at first if at all, then rises for good.
    expected = brentq(excess, 0.0, 100.0, xtol=1e-14, rtol=1e-14)
    found = blind_time(start, INTEGRATOR, np.diag([0.0, intensity]), POSITION, tolerance, 3.0, 1000.0)
    assert found == pytest.approx(expected, rel=1e-7)
    assert found <= expected * (1 + 1e-13) and excess(found) <= 0.0


OMEGA = 5.0
OSCILLATOR = np.array([[0.0, 1.0], [-(OMEGA**2), 0.0]])


@pytest.mark.parametrize("tolerance", [0.25, 0.3, 0.39, 0.3999999, 0.4])
def test_an_oscillator_is_caught_on_its_first_swing(tolerance):
    # sigma_p^2 = 1e-4 cos^2 + 0.04 sin^2: its peak of 2 sigma is 0.4, at a quarter of the period.
    start, q = np.diag([1e-4, 1.0]), np.zeros((2, 2))
    found = blind_time(start, OSCILLATOR, q, POSITION, tolerance, 2.0, 300.0)
    swing = math.asin(math.sqrt(((tolerance / 2) ** 2 - 1e-4) / (0.04 - 1e-4))) / OMEGA
    assert swing * (1 - 1e-5) <= found <= swing
    assert 2 * deviation(start, OSCILLATOR, q, POSITION, found) <= tolerance


def test_a_swing_that_stays_below_never_crosses():
    start = np.diag([1e-4, 1.0])
    assert blind_time(start, OSCILLATOR, np.zeros((2, 2)), POSITION, 0.4000001, 2.0, 20.0) == math.inf


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 4), st.integers(1, 2), st.floats(1.05, 3.0), st.booleans())
def test_never_late_and_hardly_early(seed, n, directions, factor, noisy):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n)) - rng.uniform(0, 1.5) * np.eye(n)
    root = rng.normal(size=(n, n))
    start = root @ root.T
    q = noisy * np.outer(root[:, 0], root[:, 0])
    rows = rng.normal(size=(directions, n))
    tolerance = factor * 2.0 * float(deviation(start, a, q, rows, 0.0))
    assume(tolerance > 1e-3)
    found = blind_time(start, a, q, rows, tolerance, 2.0, 4.0)
    grid = np.linspace(0.0, min(found, 4.0), 2001)
    assert (2.0 * deviation(start, a, q, rows, grid) <= tolerance).all()
    if found < math.inf:
        assert 2.0 * deviation(start, a, q, rows, found) >= tolerance * (1 - 1e-4)


def test_the_tolerance_reached_already_leaves_no_time():
    assert blind_time(np.eye(2), INTEGRATOR, np.eye(2), POSITION, 1.0, 1.0, 10.0) == 0.0
    assert blind_time(np.eye(2), INTEGRATOR, np.eye(2), POSITION, 0.5, 1.0, 10.0) == 0.0
    assert blind_time(np.eye(2), -np.eye(2), 0.1 * np.eye(2), POSITION, 0.8, 1.0, 10.0) == 0.0


def test_a_sinking_covariance_never_crosses():
    began = time.process_time()
    assert blind_time(np.eye(2), -np.eye(2), 0.1 * np.eye(2), POSITION, 1.01, 1.0, 1e9) == math.inf
    assert blind_time(np.eye(2), np.zeros((2, 2)), np.zeros((2, 2)), POSITION, 1.01, 1.0, 1e9) == math.inf
    assert time.process_time() - began < 0.1


@pytest.mark.parametrize("tolerance", [1e-12, 1.0, 1e9, 1e12])
def test_growth_that_the_first_derivatives_do_not_show(tolerance):
    # Eight integrators in a row: only the fourteenth derivative of the first one's variance, t^14 / 7!^2, is not 0.
    start, a = np.diag([0.0] * 7 + [1.0]), np.eye(8, k=1)
    start[6, 6] = 1e-30
    found = blind_time(start, a, np.zeros((8, 8)), np.eye(8)[0], tolerance, 1.0, 1e4)
    exact = (tolerance * math.factorial(7)) ** (1 / 7)
    assert exact * (1 - 1e-8) <= found <= exact


def test_a_crossing_after_the_horizon_is_none():
    walk = ([[0.0]], [[0.0]], [[1.0]], [1.0], 2.0, 1.0)
    assert blind_time(*walk, 3.999) == math.inf
    assert blind_time(*walk, 4.001) == pytest.approx(4.0, rel=1e-10)
    assert blind_time(*walk, 0.0) == math.inf
    swinging = (np.diag([1e-4, 1.0]), OSCILLATOR, np.zeros((2, 2)), POSITION, 0.3, 2.0)
    assert blind_time(*swinging, 0.1693) == math.inf
    assert blind_time(*swinging, 0.1695) == pytest.approx(0.169393, rel=1e-5)


def test_a_far_horizon_costs_no_precision_and_no_overflow():
    found = blind_time([[1.0]], [[10.0]], [[0.0]], [1.0], 2.0, 1.0, 1e7)
    assert found == pytest.approx(math.log(2.0) / 10.0, rel=1e-9)
    assert blind_time([[1.0]], [[10.0]], [[0.0]], [1.0], 1e300, 1.0, 1e7) < math.inf
    walk = blind_time(np.zeros((2, 2)), INTEGRATOR, np.diag([0.0, 3.0]), POSITION, 8.0, 1.0, 1e40)
    assert walk == pytest.approx(4.0, rel=1e-9)


def test_several_directions_take_the_worst():
    start, q = np.diag([1e-4, 4e-4, 1e-2, 4e-2]), np.diag([0.0, 0.0, 0.1, 0.4])
    a = np.eye(4, k=2)
    both = blind_time(start, a, q, np.eye(2, 4), 0.5, 3.0, 60.0)
    alone = [blind_time(start, a, q, row, 0.5, 3.0, 60.0) for row in np.eye(2, 4)]
    assert both == pytest.approx(min(alone), rel=1e-7) and alone[1] < alone[0]
    # Correlated errors are worst along neither axis.
    start[0, 1] = start[1, 0] = 1.9e-4
    assert blind_time(start, a, q, np.eye(2, 4), 0.1, 3.0, 60.0) < min(
        blind_time(start, a, q, row, 0.1, 3.0, 60.0) for row in np.eye(2, 4)
    )


@pytest.mark.parametrize("lag_s", [1.0, 0.1, 1e-2, 1e-3])
def test_a_stiff_system_is_quick(lag_s):
    # A velocity that forgets itself within lag_s: windows of 1 / |A| would be up to 60,000 here.
    a, q = np.array([[-0.001, 1.0], [0.0, -1.0 / lag_s]]), np.diag([0.0, 0.15 / lag_s**2])
    began = time.process_time()
    found = blind_time(0.01 * np.eye(2), a, q, POSITION, 4.0, 2.0, 60.0)
    assert time.process_time() - began < 0.5
    assert 4.0 * (1 - 1e-6) <= 2.0 * deviation(0.01 * np.eye(2), a, q, POSITION, found) <= 4.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tolerance": 0.0}, ["tolerance", "above 0"]),
        ({"tolerance": -1.0}, ["tolerance", "-1"]),
        ({"tolerance": math.nan}, ["tolerance", "nan"]),
        ({"sigmas": 0.0}, ["sigmas", "above 0"]),
        ({"sigmas": math.inf}, ["sigmas", "finite"]),
        ({"horizon_s": -1.0}, ["horizon_s", "backwards"]),
        ({"horizon_s": math.inf}, ["horizon_s", "finite"]),
        ({"direction": [1.0, 0.0, 0.0]}, ["direction", "(3,)"]),
        ({"direction": [math.nan, 0.0]}, ["direction", "finite"]),
        ({"P0": np.ones((3, 2, 2))}, ["P0", "(2, 2)"]),
        ({"P0": -np.eye(2)}, ["P0", "semidefinite"]),
        ({"Q": -np.eye(2)}, ["Q", "semidefinite"]),
        ({"A": [1.0]}, ["A", "square"]),
    ],
)
def test_bad_input_is_refused(change, words):
    given_ = {
        "P0": np.eye(2),
        "A": INTEGRATOR,
        "Q": np.eye(2),
        "direction": POSITION,
        "tolerance": 2.0,
        "sigmas": 1.0,
        "horizon_s": 10.0,
    }
    with pytest.raises(ConfigurationError) as refusal:
        blind_time(**{**given_, **change})
    assert all(word in str(refusal.value) for word in words), refusal.value
