"""Tracks against the covariance module, against sums by hand, and against simulated things that move as declared."""

import pickle

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import blind_covariance, double_integrator_covariance

from safe_wrappers.control.estimation import Motion, Tracks, largest_deviation

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


def test_a_double_integrator_has_its_closed_form():
    tracks = started(MOTIONS[:1])
    before = tracks.covariance[0, ::2, ::2].copy()  # position and velocity along x
    tracks.advance(1.7)
    closed = double_integrator_covariance(before, 0.3, 1.7)
    np.testing.assert_allclose(tracks.covariance[0, ::2, ::2], closed, rtol=1e-12)


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
    rng, n, dt, steps = np.random.default_rng(3), 20_000, 0.01, 100
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


def test_seeing_some_leaves_the_others_and_agrees_with_the_information_form():
    tracks = started()
    before_mean, before = tracks.mean.copy(), tracks.covariance.copy()
    matrix, noise = np.eye(2, 4), np.array([[0.04, 0.01], [0.01, 0.09]])
    measured = np.array([[0.3, -0.2]])
    tracks.see(np.array([1]), measured, matrix, noise)
    assert (tracks.mean[0] == before_mean[0]).all() and (tracks.covariance[0] == before[0]).all()
    information = np.linalg.inv(before[1]) + matrix.T @ np.linalg.inv(noise) @ matrix
    gained = np.linalg.inv(before[1]) @ before_mean[1] + matrix.T @ np.linalg.inv(noise) @ measured[0]
    np.testing.assert_allclose(tracks.covariance[1], np.linalg.inv(information), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(tracks.mean[1], np.linalg.solve(information, gained), rtol=1e-8)


@given(seed=st.integers(0, 10_000), d=st.sampled_from([1, 2, 3]))
@settings(max_examples=40)
def test_the_largest_deviation_is_no_less_than_in_any_direction(seed, d):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, d, d)) * rng.uniform(0, 1, (4, 1, 1))
    covariances = root @ root.swapaxes(1, 2)
    ways = rng.normal(size=(4000, d))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    along = np.sqrt(np.einsum("ki,nij,kj->nk", ways, covariances, ways)).max(axis=1)
    found = largest_deviation(covariances)
    assert (along <= found + 1e-9).all() and (along >= (0.8 if d == 3 else 0.99) * found - 1e-9).all()


def test_its_memory_does_not_grow_with_ever_new_times():
    tracks = started()
    sizes = []
    for i in range(600):
        tracks.advance(0.01 + 1e-5 * i)
        tracks.ahead([0.1, 0.2 + 1e-5 * i])
        sizes.append(len(pickle.dumps(tracks)))
    assert max(sizes[300:]) <= max(sizes[:300])
