"""Covariance seen and blind, against numerical integration, closed forms and python-control."""

import control as ct
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from safe_wrappers.appendix.estimation.covariance import (
    blind_covariance,
    double_integrator_covariance,
    kalman_bucy_gain,
    lyapunov_rate,
    riccati_rate,
    seen_covariance,
    steady_state,
)
from safe_wrappers.control.estimation.covariance import (
    checked_covariance,
    checked_noise,
    discretise,
    discretise_drift,
)
from safe_wrappers.errors import ConfigurationError

INTEGRATOR = np.array([[0.0, 1.0], [0.0, 0.0]])
seeds = st.integers(0, 10**6)
sizes = st.integers(1, 4)
times = st.floats(0.0, 5.0)


def random_system(seed, n, shift=0.0):
    """A, Q (often singular), P0, C, R at random."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n)) - shift * np.eye(n)
    noisy, measured = rng.integers(1, n + 1, size=2)
    root, start = rng.normal(size=(n, noisy)), rng.normal(size=(n, n))
    c = rng.normal(size=(measured, n))
    return a, root @ root.T, start @ start.T, c, np.diag(rng.uniform(0.1, 2.0, measured))


def integrated(rate, start, time):
    """The matrix equation P' = rate(P) by a stiff solver that knows nothing of exponentials."""
    shape = start.shape
    solved = solve_ivp(
        lambda _, p: rate(p.reshape(shape)).ravel(),
        (0, time),
        start.ravel(),
        method="LSODA",
        rtol=1e-11,
        atol=1e-13,
    )
    return solved.y[:, -1].reshape(shape)


def quadrature(integrand, time):
    """From 0 to the time, by 30 nodes of Gauss and Legendre: for an entire function as good as exact."""
    nodes, weights = np.polynomial.legendre.leggauss(30)
    return 0.5 * time * np.tensordot(weights, integrand(0.5 * time * (nodes + 1.0)), axes=1)


def semidefinite(matrix, scale):
    return np.linalg.eigvalsh(matrix).min() >= -1e-10 * scale


# One step of time ------------------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(seeds, sizes, st.floats(0.01, 3.0))
def test_the_step_is_the_integral_by_quadrature(seed, n, time):
    a, q, *_ = random_system(seed, n)
    expected = quadrature(lambda s: expm(s[:, None, None] * a) @ q @ expm(s[:, None, None] * a.T), time)
    step = discretise(a, q, time)
    np.testing.assert_allclose(step.transition, expm(a * time), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(step.noise, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())


def test_no_time_changes_nothing():
    a, q, start, c, r = random_system(3, 3)
    step = discretise(a, q, 0.0)
    assert np.array_equal(step.transition, np.eye(3)) and not step.noise.any()
    assert not discretise_drift(a, np.ones(3), 0.0).any()
    assert np.array_equal(blind_covariance(start, a, q, 0.0), start)
    np.testing.assert_allclose(seen_covariance(start, a, q, c, r, 0.0), start, rtol=1e-13)


def test_a_stable_system_over_a_long_time_does_not_overflow():
    # exp(-A t) of the textbook block would be exp(1e5).
    step = discretise([[-100.0]], [[3.0]], [1.0, 1000.0, 1e9])
    np.testing.assert_allclose(step.noise.ravel(), 3.0 / 200.0, rtol=1e-14)
    np.testing.assert_allclose(step.transition.ravel()[1:], 0.0, atol=1e-300)


def test_several_times_are_several_steps():
    a, q, *_ = random_system(5, 3)
    over = np.array([[0.0, 0.3], [2.0, 40.0]])
    together = discretise(a, q, over)
    assert together.transition.shape == together.noise.shape == (2, 2, 3, 3)
    for index in np.ndindex(over.shape):
        alone = discretise(a, q, over[index])
        np.testing.assert_array_equal(together.transition[index], alone.transition)
        np.testing.assert_array_equal(together.noise[index], alone.noise)


@settings(max_examples=20)
@given(seeds, sizes, st.floats(0.0, 3.0), st.booleans())
def test_a_drift_carries_as_integrated(seed, n, time, singular):
    a, *_ = random_system(seed, n)
    if singular:
        a[:, 0] = 0.0
    b = np.random.default_rng(seed).normal(size=n)
    expected = quadrature(lambda s: expm(s[:, None, None] * a) @ b, time)
    np.testing.assert_allclose(discretise_drift(a, b, time), expected, rtol=1e-9, atol=1e-11)


def test_a_drift_over_a_long_time_settles():
    carried = discretise_drift(np.diag([-100.0, -0.5]), [3.0, 1.0], [1.0, 1e9])
    np.testing.assert_allclose(carried[0], [0.03, 2.0 * -np.expm1(-0.5)], rtol=1e-12)
    np.testing.assert_allclose(carried[1], [0.03, 2.0], rtol=1e-12)


def test_drifts_and_times_broadcast():
    b = np.array([[0.0, 1.0], [0.0, -2.0], [3.0, 0.0]])
    carried = discretise_drift(INTEGRATOR, b, [0.5, 2.0])
    assert carried.shape == (2, 3, 2)
    for k, t in enumerate((0.5, 2.0)):
        np.testing.assert_allclose(carried[k], [[t**2 / 2, t], [-(t**2), -2 * t], [3 * t, 0]], rtol=1e-14)


# Blind ------------------------------------------------------------------------------------------------------------


@given(st.floats(0, 10), st.floats(-0.99, 0.99), st.floats(0, 10), st.floats(0, 10), st.floats(1e-3, 1e3))
def test_the_double_integrator_agrees_with_its_closed_form(p, correlation, v, intensity, time):
    start = np.array([[p, correlation * np.sqrt(p * v)], [correlation * np.sqrt(p * v), v]])
    closed = double_integrator_covariance(start, intensity, time)
    exact = blind_covariance(start, INTEGRATOR, np.diag([0.0, intensity]), time)
    deviation = np.sqrt(np.diag(closed))
    scale = np.outer(deviation, deviation)
    np.testing.assert_array_less(np.abs(closed - exact), 1e-10 * scale + 1e-300)


def test_the_closed_form_is_the_appendix_s():
    start = np.array([[0.04, 0.01], [0.01, 0.09]])
    t, q = np.linspace(0, 50, 101), 0.3
    grown = double_integrator_covariance(start, q, t)
    np.testing.assert_allclose(grown[:, 0, 0], 0.04 + 2 * 0.01 * t + 0.09 * t**2 + q * t**3 / 3, rtol=1e-14)
    np.testing.assert_allclose(grown[:, 0, 1], 0.01 + 0.09 * t + q * t**2 / 2, rtol=1e-14)
    np.testing.assert_allclose(grown[:, 1, 1], 0.09 + q * t, rtol=1e-14)
    np.testing.assert_allclose(grown, np.swapaxes(grown, -1, -2))
    exact = blind_covariance(start, INTEGRATOR, np.diag([0.0, q]), t)
    np.testing.assert_allclose(np.sqrt(exact[:, 0, 0]), np.sqrt(grown[:, 0, 0]), rtol=1e-10)


def test_the_regimes_of_growth():
    t = np.array([1.0, 2.0, 4.0, 8.0])
    walk = blind_covariance([[0.0]], [[0.0]], [[3.0]], t).ravel()
    np.testing.assert_allclose(walk, 3.0 * t, rtol=1e-13)
    unstable = blind_covariance([[2.0]], [[0.5]], [[0.0]], t).ravel()
    np.testing.assert_allclose(unstable, 2.0 * np.exp(t), rtol=1e-12)
    bounded = blind_covariance([[0.0]], [[-2.0]], [[1.0]], 50.0).item()
    assert bounded == pytest.approx(0.25)
    velocity = blind_covariance(np.diag([0.0, 1.0]), INTEGRATOR, np.zeros((2, 2)), t)[:, 0, 0]
    np.testing.assert_allclose(velocity[1:] / velocity[:-1], 4.0, rtol=1e-12)
    noise = blind_covariance(np.zeros((2, 2)), INTEGRATOR, np.diag([0.0, 1.0]), t)[:, 0, 0]
    np.testing.assert_allclose(noise[1:] / noise[:-1], 8.0, rtol=1e-12)


@given(seeds, sizes, times, times)
def test_blind_over_one_time_and_then_another_is_blind_over_both(seed, n, first, second):
    a, q, start, *_ = random_system(seed, n)
    both = blind_covariance(start, a, q, first + second)
    split = blind_covariance(blind_covariance(start, a, q, first), a, q, second)
    np.testing.assert_allclose(split, both, rtol=1e-8, atol=1e-10 * np.abs(both).max())


@given(seeds, sizes, times)
def test_growth_is_symmetric_semidefinite_and_rises_with_the_noise_and_the_start(seed, n, time):
    a, q, start, *_ = random_system(seed, n)
    grown = blind_covariance(start, a, q, time)
    scale = np.abs(grown).max()
    assert np.array_equal(grown, grown.T) and semidefinite(grown, scale)
    more = random_system(seed + 1, n)[1]
    assert semidefinite(
        blind_covariance(start, a, q + more, time) - grown, np.abs(more).max() * scale + scale
    )
    assert semidefinite(
        blind_covariance(start + more, a, q, time) - grown, np.abs(more).max() * scale + scale
    )


def test_tracks_and_times_make_axes():
    a, q, *_ = random_system(8, 3)
    starts = np.stack([random_system(k, 3)[2] for k in range(4)])
    c, r = np.eye(1, 3), np.eye(1)
    blind, seen = blind_covariance(starts, a, q, [0.1, 1.0]), seen_covariance(starts, a, q, c, r, [0.1, 1.0])
    assert blind.shape == seen.shape == (2, 4, 3, 3)
    for k, t in enumerate((0.1, 1.0)):
        for i in range(4):
            np.testing.assert_allclose(blind[k, i], blind_covariance(starts[i], a, q, t), rtol=1e-12)
            np.testing.assert_allclose(seen[k, i], seen_covariance(starts[i], a, q, c, r, t), rtol=1e-10)


# Seen -------------------------------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(seeds, st.integers(1, 3), st.floats(0.01, 4.0))
def test_seen_and_blind_are_the_integrated_equations(seed, n, time):
    a, q, start, c, r = random_system(seed, n)

    def lyapunov(p):
        return a @ p + p @ a.T + q

    def riccati(p):
        return lyapunov(p) - p @ c.T @ np.linalg.inv(r) @ c @ p

    np.testing.assert_allclose(lyapunov_rate(start, a, q), lyapunov(start), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(riccati_rate(start, a, q, c, r), riccati(start), rtol=1e-9, atol=1e-9)
    for rate, got in (
        (lyapunov, blind_covariance(start, a, q, time)),
        (riccati, seen_covariance(start, a, q, c, r, time)),
    ):
        expected = integrated(rate, start, time)
        np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def test_rates_take_a_batch_of_covariances():
    a, q, start, c, r = random_system(4, 3)
    batch = np.stack([start, 2.0 * start])
    np.testing.assert_allclose(lyapunov_rate(batch, a, q)[1], lyapunov_rate(2 * start, a, q), rtol=1e-13)
    np.testing.assert_allclose(riccati_rate(batch, a, q, c, r)[1], riccati_rate(2 * start, a, q, c, r))
    np.testing.assert_allclose(kalman_bucy_gain(batch, c, r)[1], kalman_bucy_gain(2 * start, c, r))


@settings(max_examples=40)
@given(seeds, sizes, times, times)
@example(0, 2, 0.0, 0.125)
def test_seen_over_one_time_and_then_another_is_seen_over_both(seed, n, first, second):
    a, q, start, c, r = random_system(seed, n)
    both = seen_covariance(start, a, q, c, r, first + second)
    split = seen_covariance(seen_covariance(start, a, q, c, r, first), a, q, c, r, second)
    assert np.array_equal(both, both.T) and semidefinite(both, np.abs(both).max())
    np.testing.assert_allclose(split, both, rtol=1e-7, atol=1e-8 * np.abs(both).max())


@settings(max_examples=40)
@given(seeds, sizes, times)
def test_measuring_never_makes_it_worse(seed, n, time):
    a, q, start, c, r = random_system(seed, n)
    blind, seen = blind_covariance(start, a, q, time), seen_covariance(start, a, q, c, r, time)
    assert semidefinite(blind - seen, np.abs(blind).max())


@pytest.mark.parametrize("seed", range(5))
def test_long_times_lead_to_the_steady_state(seed):
    a, _, start, c, r = random_system(seed, 4)
    q = np.eye(4)
    steady = steady_state(a, q, c, r)
    over = seen_covariance(start, a, q, c, r, [1e2, 1e4, 1e8])
    np.testing.assert_allclose(over, np.broadcast_to(steady, over.shape), rtol=1e-6, atol=1e-8 * steady.max())
    assert np.abs(riccati_rate(steady, a, q, c, r)).max() <= 1e-9 * np.abs(steady).max() ** 2


@pytest.mark.parametrize("time", [1.0, 30.0, 400.0, 1e4])
def test_an_unstable_mode_without_noise_is_learnt_however_long_it_takes(time):
    # p' = 2 a p - s p^2 has a closed form; the pieces of its flow leave the range of floats at 2 a t = 709.
    a, s, p = 1.0, 4.0, 1e-3
    exact = 1.0 / (np.exp(-2 * a * time) / p + s / (2 * a) * -np.expm1(-2 * a * time))
    seen = seen_covariance(
        np.diag([p, 0.1]), np.diag([a, -1.0]), np.diag([0, 0.7]), [[1.0, 0.0]], [[0.25]], time
    )
    assert seen[0, 0] == pytest.approx(exact, rel=1e-12)
    assert seen[1, 1] == pytest.approx(0.35 + (0.1 - 0.35) * np.exp(-2 * time), rel=1e-12)


def test_a_constant_is_learnt_with_one_over_time():
    t = np.array([0.0, 1.0, 1e3, 1e9])
    learnt = seen_covariance([[2.0]], [[0.0]], [[0.0]], [[1.0]], [[0.5]], t).ravel()
    np.testing.assert_allclose(learnt, 1.0 / (0.5 + t / 0.5), rtol=1e-13)


def test_a_vague_start_is_no_trouble():
    got = seen_covariance(1e12 * np.eye(2), INTEGRATOR, np.diag([0.0, 0.2]), [[1.0, 0.0]], [[0.01]], 200.0)
    np.testing.assert_allclose(
        got, steady_state(INTEGRATOR, np.diag([0.0, 0.2]), [[1.0, 0.0]], [[0.01]]), rtol=1e-9
    )


# Steady -----------------------------------------------------------------------------------------------------------


def test_the_steady_state_and_its_gain_are_python_control_s():
    for seed in range(10):
        a, q, _, c, r = random_system(seed, 3, shift=1.5)
        gain, steady, _ = ct.lqe(a, np.eye(3), c, q, r)
        np.testing.assert_allclose(steady_state(a, q, c, r), steady, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(kalman_bucy_gain(steady, c, r), gain, rtol=1e-7, atol=1e-9)


def test_the_double_integrator_s_steady_state_is_the_textbook_s():
    q, r = 0.3, 0.02
    steady = steady_state(INTEGRATOR, np.diag([0.0, q]), [[1.0, 0.0]], [[r]])
    bandwidth = (q / r) ** 0.25
    np.testing.assert_allclose(
        steady,
        r * np.array([[np.sqrt(2) * bandwidth, bandwidth**2], [bandwidth**2, np.sqrt(2) * bandwidth**3]]),
    )


TURN = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]


@pytest.mark.parametrize("turn", [np.eye(3), TURN])
@pytest.mark.parametrize(
    ("a", "noise", "c", "words"),
    [
        (
            np.diag([-1.0, 0.5, -2.0]),
            [1, 1, 1],
            [[1.0, 0.0, 1.0]],
            ["not detectable", "0.5", "C does not see"],
        ),
        (np.diag([-1.0, 0.0, -2.0]), [1, 1, 1], [[1.0, 0.0, 1.0]], ["not detectable", "grows without end"]),
        (
            np.diag([-1.0, 0.5, -2.0]),
            [1, 0, 1],
            [[1.0, 1.0, 1.0]],
            ["not stabilisable", "0.5", "no noise of Q"],
        ),
        ([[0, 1, 0], [0, 0, 0], [0, 0, -1.0]], [0, 1, 1], [[0.0, 1.0, 1.0]], ["not detectable"]),
        ([[0, 1, 0], [0, 0, 0], [0, 0, -1.0]], [1, 0, 1], [[1.0, 0.0, 1.0]], ["not stabilisable"]),
    ],
)
def test_no_steady_state_is_refused_with_the_reason(a, noise, c, words, turn):
    a, q, c = (
        turn @ np.asarray(a, float) @ turn.T,
        turn @ np.diag(np.asarray(noise, float)) @ turn.T,
        c @ turn.T,
    )
    with pytest.raises(ConfigurationError) as refusal:
        steady_state(a, q, c, [[1.0]])
    assert all(word in str(refusal.value) for word in words), refusal.value


def test_the_refusal_names_the_direction():
    with pytest.raises(ConfigurationError, match=r"mode 0.5 1/s, direction \[-?0\. +-?1\.\]"):
        steady_state(np.diag([-1.0, 0.5]), np.eye(2), [[1.0, 0.0]], [[1.0]])


def test_a_mode_that_decays_need_be_neither_seen_nor_noisy():
    steady = steady_state(np.diag([1.0, -1.0]), np.diag([1.0, 0.0]), [[1.0, 0.0]], [[1.0]])
    np.testing.assert_allclose(steady, np.diag([1 + np.sqrt(2), 0.0]), atol=1e-12)


# Bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ([[1.0, 2.0], [0.0, 1.0]], ["symmetric", "2"]),
        ([[1.0, 2.0], [2.0, 1.0]], ["semidefinite", "-1"]),
        (np.diag([1e-12, -1e-13]), ["semidefinite", "-1e-13"]),
        ([[0.0, 1e-12], [0.0, 0.0]], ["symmetric", "1e-12"]),
        ([[1.0, np.nan], [np.nan, 1.0]], ["finite"]),
        ([1.0, 2.0], ["square", "(2,)"]),
        (np.ones((2, 3)), ["square", "(2, 3)"]),
        (np.eye(3), ["2 x 2", "(3, 3)"]),
        ("wide", ["number"]),
    ],
)
def test_what_is_no_covariance_is_refused(matrix, words):
    with pytest.raises(ConfigurationError) as refusal:
        checked_covariance("P0", matrix, 2)
    assert all(word in str(refusal.value) for word in ["P0", *words]), refusal.value


def test_a_covariance_passes_singular_and_rounded():
    assert checked_covariance("Q", np.zeros((2, 2))).shape == (2, 2)
    root = np.random.default_rng(0).normal(size=(5, 2))
    rounded = root @ root.T + 1e-13 * np.random.default_rng(1).normal(size=(5, 5))
    checked = checked_covariance("P", rounded)
    assert np.array_equal(checked, checked.T)
    with pytest.raises(ConfigurationError, match=r"positive definite .* smallest eigenvalue is"):
        checked_noise("R", np.diag([1.0, 0.0]))
    with pytest.raises(ConfigurationError, match="R must be positive definite"):
        checked_noise("R", np.diag([1.0, -0.5]))
    assert checked_noise("R", np.diag([1.0, 1e-6]))[1, 1] == 1e-6


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: discretise(INTEGRATOR, np.eye(2), -0.1), ["time_s", "-0.1", "backwards"]),
        (lambda: discretise(INTEGRATOR, np.eye(2), [1.0, np.inf]), ["time_s", "finite"]),
        (lambda: discretise(INTEGRATOR, -np.eye(2), 1.0), ["Q", "semidefinite"]),
        (lambda: discretise(INTEGRATOR, np.eye(3), 1.0), ["Q", "2 x 2"]),
        (lambda: discretise(np.ones((2, 3)), np.eye(2), 1.0), ["A", "square"]),
        (lambda: discretise([[10.0]], [[1.0]], 100.0), ["unstable", "100"]),
        (lambda: discretise_drift(INTEGRATOR, [1.0], 1.0), ["b must have 2"]),
        (lambda: discretise_drift(INTEGRATOR, [0.0, 1.0], -1.0), ["backwards"]),
        (lambda: discretise_drift([[10.0]], [1.0], 100.0), ["unstable"]),
        (lambda: blind_covariance(-np.eye(2), INTEGRATOR, np.eye(2), 1.0), ["P0"]),
        (lambda: blind_covariance(np.eye(2), INTEGRATOR, np.eye(2), -1.0), ["backwards"]),
        (lambda: blind_covariance([[1e300]], [[10.0]], [[0.0]], 5.0), ["unstable"]),
        (
            lambda: seen_covariance(np.eye(2), INTEGRATOR, np.eye(2), np.eye(2), np.eye(2), -1.0),
            ["backwards"],
        ),
        (
            lambda: seen_covariance(np.eye(2), INTEGRATOR, np.eye(2), np.eye(3), np.eye(3), 1.0),
            ["C", "(m, 2)"],
        ),
        (
            lambda: seen_covariance(np.eye(2), INTEGRATOR, np.eye(2), [[1, 0]], [[0.0]], 1.0),
            ["R", "definite"],
        ),
        (lambda: seen_covariance(np.eye(2), 9 * np.eye(2), np.eye(2), [[1, 0]], [[1]], 99.0), ["unstable"]),
        (lambda: steady_state(INTEGRATOR, np.eye(2), [[1, 0]], np.eye(2)), ["R must be 1 x 1"]),
        (lambda: double_integrator_covariance(np.eye(3), 1.0, 1.0), ["P0", "2 x 2"]),
        (lambda: double_integrator_covariance(np.ones((4, 2, 2)), 1.0, 1.0), ["P0", "(2, 2)"]),
        (lambda: double_integrator_covariance(np.eye(2), -1.0, 1.0), ["intensity", "-1"]),
        (lambda: double_integrator_covariance(np.eye(2), 1.0, -1.0), ["backwards"]),
    ],
)
def test_bad_input_is_refused_and_named(call, words):
    with pytest.raises(ConfigurationError) as refusal:
        call()
    assert all(word in str(refusal.value) for word in words), refusal.value
