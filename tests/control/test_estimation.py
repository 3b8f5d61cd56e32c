"""Estimates: quadrature, Bayes' rule, python-control, exact ranks, and simulated things that move as declared."""

from fractions import Fraction

import control
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import blind_covariance
from scipy.linalg import expm

from safe_wrappers.control.estimation import (
    Motion,
    Tracks,
    discretise,
    largest_deviation,
    predict,
    unobservable_states,
    unobservable_subspace,
    update,
)

SEEDS, SIZES = st.integers(0, 10**6), st.integers(1, 4)


def covariance(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2)


# One step of time -------------------------------------------------------------------------------------------------


def quadrature(integrand, time):
    """From 0 to the time, by 30 nodes of Gauss and Legendre: for an entire function as good as exact."""
    nodes, weights = np.polynomial.legendre.leggauss(30)
    return 0.5 * time * np.tensordot(weights, integrand(0.5 * time * (nodes + 1.0)), axes=1)


@given(SEEDS, SIZES, st.floats(0.01, 3.0), st.booleans())
def test_the_step_is_the_integral_by_quadrature(seed, n, time, singular):
    rng = np.random.default_rng(seed)
    a, b, root = rng.normal(size=(n, n)), rng.normal(size=n), rng.normal(size=(n, rng.integers(1, n + 1)))
    a[:, 0] *= not singular
    q, powers = root @ root.T, lambda s: expm(s[:, None, None] * a)  # often singular, too
    transition, drift, noise = discretise(a, q, time, b)
    expected = quadrature(lambda s: powers(s) @ q @ powers(s).swapaxes(1, 2), time)
    np.testing.assert_allclose(transition, expm(a * time), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(noise, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(drift, quadrature(lambda s: powers(s) @ b, time), rtol=1e-9, atol=1e-11)


def test_no_time_changes_nothing_and_over_a_long_time_nothing_overflows():
    a = np.array([[0.3, -2.0], [1.0, 0.1]])
    transition, drift, noise = discretise(a, np.eye(2), 0.0, np.ones(2))
    assert np.array_equal(transition, np.eye(2)) and not noise.any() and not drift.any()
    # exp(-A t) of the textbook block would be exp(1e5).
    for time in (1.0, 1000.0, 1e9):
        settled = -np.expm1(-0.5 * time)
        transition, drift, noise = discretise(np.diag([-100.0, -0.5]), 3.0 * np.eye(2), time, [3.0, 1.0])
        np.testing.assert_allclose(np.diag(noise), [0.015, -3.0 * np.expm1(-time)], rtol=1e-12)
        np.testing.assert_allclose(drift, [0.03, 2.0 * settled], rtol=1e-12)
        np.testing.assert_allclose(np.diag(transition), [0.0, np.exp(-0.5 * time)], rtol=1e-9, atol=1e-40)


# One measurement --------------------------------------------------------------------------------------------------


@given(SEEDS, SIZES, st.integers(1, 3))
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


@given(SEEDS, SIZES, st.floats(-8, 8))
def test_the_covariance_stays_symmetric_and_semidefinite(seed, n, decades):
    rng = np.random.default_rng(seed)
    cov, c = covariance(rng, n), rng.normal(size=(1, n))
    for _ in range(20):
        cov = update(np.zeros(n), cov, np.zeros(1), c, np.array([[10.0**decades]]))[1]
        assert np.array_equal(cov, cov.T)
        assert np.linalg.eigvalsh(cov).min() >= -1e-13 * np.abs(cov).max()
        _, cov = predict(np.zeros(n), cov, np.eye(n) + 0.1 * rng.normal(size=(n, n)), 1e-9 * np.eye(n))
        assert np.array_equal(cov, cov.T)


# Tracks -----------------------------------------------------------------------------------------------------------

MOTIONS = [
    Motion(np.diag([0.3, 0.0]), np.inf, np.array([0.5, 0.0])),
    Motion(np.array([[0.2, 0.1], [0.1, 0.4]]), 0.7, np.array([1.0, -2.0])),
]


def started(motions=MOTIONS, seed=0):
    rng, d = np.random.default_rng(seed), motions[0].mean_velocity.size
    roots = rng.normal(size=(len(motions), 2 * d, 2 * d)) * 0.3
    tracks = Tracks(motions)
    tracks.start(rng.normal(size=(len(motions), 2 * d)), roots @ roots.swapaxes(1, 2))
    return tracks


@given(times=st.lists(st.floats(1e-3, 5.0), min_size=1, max_size=5), seed=st.integers(0, 99))
@settings(max_examples=30)
def test_many_short_times_are_one_long_one_and_what_ahead_foretells(times, seed):
    stepwise = started(seed=seed)
    foretold = stepwise.ahead(np.cumsum(times).tolist())
    at_start = stepwise.covariance.copy()
    for i, time_s in enumerate(times):
        stepwise.advance(time_s)
        np.testing.assert_allclose(stepwise.positions, foretold[0][i], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(stepwise.position_covariances, foretold[1][i], rtol=1e-9, atol=1e-11)
    for motion, before, after in zip(stepwise.motions, at_start, stepwise.covariance, strict=True):
        a, _, q = motion.matrices()
        np.testing.assert_allclose(after, blind_covariance(before, a, q, sum(times)), rtol=1e-9, atol=1e-11)


def test_simulated_things_are_where_the_covariance_says():
    # Euler-Maruyama with fine steps: no formula of the library is in it.
    rng, n, dt, steps = np.random.default_rng(3), 10_000, 0.01, 100
    for motion in MOTIONS:
        tracks = started([motion], seed=1)
        states = rng.multivariate_normal(tracks.mean[0], tracks.covariance[0], n)
        values, vectors = np.linalg.eigh(motion.intensity)
        root = vectors * np.sqrt(np.maximum(values, 0.0) * dt)
        for _ in range(steps):
            pull = (motion.mean_velocity - states[:, 2:]) / motion.reversion_s
            states[:, :2] += dt * states[:, 2:] + 0.5 * dt * dt * pull
            states[:, 2:] += dt * pull + rng.normal(size=(n, 2)) @ root.T
        tracks.advance(dt * steps)
        spread = np.sqrt(np.diag(tracks.covariance[0]))
        assert (np.abs(states.mean(0) - tracks.mean[0]) < 4.5 * spread / np.sqrt(n) + 0.01).all()
        np.testing.assert_allclose(
            np.cov(states.T), tracks.covariance[0], atol=0.04 * float(np.square(spread).max())
        )


def test_seeing_some_leaves_the_others():
    tracks = started()
    mean, covariance = tracks.mean.copy(), tracks.covariance.copy()
    seen = np.array([[0.3, -0.2]]), np.eye(2, 4), np.array([[0.04, 0.01], [0.01, 0.09]])
    mean[1:], covariance[1:] = update(mean[1:], covariance[1:], *seen)
    tracks.see(np.array([1]), *seen)
    np.testing.assert_array_equal(tracks.mean, mean)
    np.testing.assert_array_equal(tracks.covariance, covariance)


@given(SEEDS, st.integers(1, 3))
def test_the_largest_deviation_is_the_largest_singular_value_of_a_root(seed, d):
    root = np.random.default_rng(seed).normal(size=(4, d, d))
    largest = np.linalg.svd(root, compute_uv=False)[:, 0]
    np.testing.assert_allclose(largest_deviation(root @ root.swapaxes(1, 2)), largest, rtol=1e-9)


def test_its_memory_does_not_grow_with_ever_new_times():
    tracks = started()
    for i in range(400):
        tracks.advance(0.01 + 1e-5 * i)
    assert 0 < len(tracks._known) <= 256


# Observability ----------------------------------------------------------------------------------------------------


@st.composite
def integer_systems(draw):
    """Many of them unobservable: sparse, with small entries, often one state that nothing shows."""
    n, m = draw(st.integers(1, 5)), draw(st.integers(1, 2))
    rng = np.random.default_rng(draw(SEEDS))
    a, c = rng.integers(-2, 3, (n, n)) * rng.integers(0, 2, (n, n)), rng.integers(-2, 3, (m, n))
    if n > 1 and draw(st.booleans()):
        hidden = draw(st.integers(0, n - 1))
        a[np.arange(n) != hidden, hidden] = 0
        c[:, hidden] = 0
    return a.astype(float), c.astype(float)


def exact_rank(rows):
    """Of rows of fractions, by elimination."""
    rows, rank = [list(map(Fraction, row)) for row in rows], 0
    while rows:
        pivot = rows.pop()
        column = next((k for k, value in enumerate(pivot) if value), None)
        if column is not None:
            rank += 1
            rows = [
                [v - row[column] / pivot[column] * w for v, w in zip(row, pivot, strict=True)] for row in rows
            ]
    return rank


@given(integer_systems())
def test_the_rank_is_the_exact_one_and_the_basis_is_in_the_kernel(system):
    a, c = system
    n, basis, seen = len(a), unobservable_subspace(a, c), control.obsv(a, c)
    hidden = n - exact_rank(seen)
    assert basis.shape == (n, hidden)
    np.testing.assert_allclose(basis.T @ basis, np.eye(hidden), atol=1e-12)
    np.testing.assert_allclose(seen @ basis, 0.0, atol=1e-9 * 20.0**n)
    # A state is determined where its unit vector adds nothing to the rank.
    names = tuple("abcde"[k] for k in range(n) if exact_rank([*seen, np.eye(n)[k]]) > n - hidden)
    assert unobservable_states(a, c, "abcde"[:n]) == names
    assert unobservable_states(1e6 * a, 1e-3 * c, "abcde"[:n]) == names


def test_fast_and_slow_modes_side_by_side():
    """Powers of A up to 1e3^7: a rank of the plain matrix loses the slow ones."""
    a, c = np.diag([1e-3, -2e-3, 0.3, -0.7, 11.0, -13.0, 500.0, 1000.0]), np.ones((1, 8))
    assert np.linalg.matrix_rank(control.obsv(a, c)) < 8
    assert unobservable_states(a, c, "abcdefgh") == ()
