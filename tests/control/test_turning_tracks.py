"""Turning tracks against an ODE solver, finite differences, simulated turns, and linear tracks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from safe_wrappers.control.estimation.tracks import Motion, Tracks, largest_deviation
from safe_wrappers.control.estimation.turning import flow
from safe_wrappers.control.estimation.turning_tracks import TurningTracks, tracks_of
from safe_wrappers.errors import ConfigurationError

MOTIONS = [
    Motion(np.diag([0.05, 0.02]), np.inf, np.zeros(2), 0.1),
    Motion(np.array([[0.2, 0.1], [0.1, 0.4]]), 0.7, np.array([1.0, -2.0]), 0.3),
    Motion(np.diag([0.3, 0.0]), 2.0, np.array([0.5, 0.0])),  # does not turn
]
STATES = np.array([[1.0, 2.0, 1.0, 0.5, 0.8], [0.0, -1.0, -0.5, 1.5, -2.5], [0.3, 0.2, 1.0, 0.0, 0.0]])


def started(motions=MOTIONS, states=STATES, spread=0.1, seed=0):
    rng = np.random.default_rng(seed)
    tracks = TurningTracks(motions)
    roots = spread * rng.normal(size=(len(motions), 5, 5))
    for i, motion in enumerate(motions):
        if motion.turn_noise is None:
            roots[i, 4] = 0.0
    tracks.start(states[: len(motions)], roots @ roots.swapaxes(1, 2))
    return tracks


def rate(motion, state):
    """Written out anew: x' of a state (5,)."""
    _, _, vx, vy, omega = state
    pull = (motion.mean_velocity - [vx, vy]) / motion.reversion_s
    return np.array([vx, vy, pull[0] - omega * vy, pull[1] + omega * vx, 0.0])


def solved(motion, state, time_s):
    if time_s == 0.0:
        return np.array(state)
    found = solve_ivp(lambda t, x: rate(motion, x), (0.0, time_s), state, rtol=1e-11, atol=1e-12)
    return found.y[:, -1]


@pytest.mark.parametrize("time_s", [0.0, 0.01, 0.4, 0.69])
def test_the_flow_and_its_jacobian_are_the_solver_s_and_its_differences(time_s):
    tracks = started()
    assert time_s <= tracks.turns.longest_s(tracks.mean)
    found = flow(tracks.turns, tracks.mean, np.array(time_s))
    for i, motion in enumerate(MOTIONS):
        np.testing.assert_allclose(found.state[i], solved(motion, STATES[i], time_s), rtol=1e-9, atol=1e-9)
        for j, step in enumerate(1e-5 * np.eye(5)):
            ends = [solved(motion, STATES[i] + sign * step, time_s) for sign in (1.0, -1.0)]
            slope = (ends[0] - ends[1]) / 2e-5
            np.testing.assert_allclose(found.jacobian[i][:, j], slope, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("time_s", [0.02, 0.5, 3.0])
def test_the_covariance_follows_the_lyapunov_equation_along_the_way(time_s):
    tracks = started()
    before = tracks.covariance.copy()
    tracks.advance(time_s)
    for i, motion in enumerate(MOTIONS):

        def slope(t, packed, motion=motion):
            state, covariance = packed[:5], packed[5:].reshape(5, 5)
            a, q, r = np.zeros((5, 5)), np.zeros((5, 5)), 1.0 / motion.reversion_s
            a[0, 2] = a[1, 3] = 1.0
            a[2:4, 2:4] = [[-r, -state[4]], [state[4], -r]]
            a[2:4, 4] = -state[3], state[2]
            q[2:4, 2:4], q[4, 4] = motion.intensity, motion.turn_noise or 0.0
            change = a @ covariance + covariance @ a.T + q
            return np.concatenate([rate(motion, state), change.ravel()])

        start = np.concatenate([STATES[i], before[i].ravel()])
        end = solve_ivp(slope, (0.0, time_s), start, rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(tracks.mean[i], end[:5], rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(tracks.covariance[i], end[5:].reshape(5, 5), rtol=1e-6, atol=1e-7)


@given(times=st.lists(st.floats(1e-3, 4.0), min_size=1, max_size=5), seed=st.integers(0, 99))
@settings(max_examples=30)
def test_many_short_times_are_one_long_one_and_what_ahead_foretells(times, seed):
    stepwise = started(seed=seed)
    positions, covariances = stepwise.ahead(np.cumsum(times).tolist())
    for i, time_s in enumerate(times):
        stepwise.advance(time_s)
        scale = 1e-9 * (1.0 + np.abs(covariances[i]).max())
        np.testing.assert_allclose(stepwise.positions, positions[i], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(stepwise.position_covariances, covariances[i], rtol=1e-8, atol=scale)
        assert (np.linalg.eigvalsh(stepwise.covariance) >= -1e-9 * np.abs(stepwise.covariance).max()).all()


def test_where_nothing_turns_it_is_the_linear_track():
    motions = [m._replace(turn_noise=None) for m in MOTIONS]
    linear, turning = Tracks(motions), started(motions)
    states = STATES.copy()
    states[:, 4] = 0.0
    turning.start(states, turning.covariance)
    linear.start(states[:, :4], turning.covariance[:, :4, :4])
    matrix, noise = np.eye(2, 4), 0.01 * np.eye(2)
    for time_s in (0.04, 0.5, 3.0):
        for tracks in (linear, turning):
            tracks.advance(time_s)
            tracks.see(np.array([0, 2]), np.array([[1.0, 2.0], [0.5, 0.5]]), matrix, noise)
        np.testing.assert_allclose(turning.mean[:, :4], linear.mean, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(turning.covariance[:, :4, :4], linear.covariance, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(turning.ahead([0.3, 2.0])[0], linear.ahead([0.3, 2.0])[0], rtol=1e-9)
        assert (turning.mean[:, 4] == 0.0).all() and (turning.covariance[:, 4] == 0.0).all()


TURNING = Motion(np.diag([0.01, 0.01]), np.inf, np.zeros(2), 0.05)
DT = 0.02


def simulated(rng, states, time_s, motion=TURNING, dt=0.002):
    """States (n, 5) after a time, by Heun's rule with fine steps: no formula of the library is in it."""
    states = states.copy()
    root = np.sqrt(np.append(np.diag(motion.intensity), motion.turn_noise) * dt)

    def slope(x):
        return np.stack([x[:, 2], x[:, 3], -x[:, 4] * x[:, 3], x[:, 4] * x[:, 2], 0 * x[:, 4]], axis=1)

    for _ in range(round(time_s / dt)):
        guess = states + dt * slope(states)
        states = states + 0.5 * dt * (slope(states) + slope(guess))
        states[:, 2:] += root * rng.normal(size=(len(states), 3))
    return states


def outside(tracks, truth, k):
    """Share of the tracks whose position is outside k sigma."""
    off = (truth[:, :2] - tracks.positions)[:, :, None]
    squared = (off.swapaxes(1, 2) @ np.linalg.solve(tracks.position_covariances, off)).ravel()
    return (squared > k * k).mean()


def test_simulated_turns_stay_within_k_sigma_and_a_track_that_knows_of_no_turn_loses_them():
    rng, n = np.random.default_rng(5), 2000
    truth = np.zeros((n, 5))
    heading = rng.uniform(0.0, 2.0 * np.pi, n)
    truth[:, 2:4] = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    truth[:, 4] = rng.normal(0.0, 1.0, n)
    start = np.diag([0.05, 0.05, 0.7, 0.7, 1.0]) ** 2
    turning = TurningTracks([TURNING] * n)
    straight = Tracks([TURNING._replace(turn_noise=None)] * n)
    turning.start(np.zeros((n, 5)), np.tile(start, (n, 1, 1)))
    straight.start(np.zeros((n, 4)), np.tile(start[:4, :4], (n, 1, 1)))
    matrix, noise = np.eye(2, 4), 0.02**2 * np.eye(2)
    for _ in range(100):  # seen for 2 s
        truth = simulated(rng, truth, DT)
        measured = truth[:, :2] + 0.02 * rng.normal(size=(n, 2))
        for tracks in (turning, straight):
            tracks.advance(DT)
            tracks.see(np.arange(n), measured, matrix, noise)
    # promised of a Gaussian in the plane: 13.5 % and 1.1 %
    assert outside(turning, truth, 2.0) == pytest.approx(0.135, abs=0.03)
    assert outside(turning, truth, 3.0) == pytest.approx(0.011, abs=0.012)
    for _ in range(2):  # not seen for 0.5 s, and for 1 s
        truth = simulated(rng, truth, 0.5)
        turning.advance(0.5)
        straight.advance(0.5)
        assert outside(turning, truth, 3.0) <= 0.03
        assert outside(straight, truth, 3.0) >= 0.2
    fast = np.abs(truth[:, 4]) > 0.5
    assert np.abs(turning.mean[:, 4] - truth[:, 4])[fast].mean() < 0.3


def test_the_turn_rate_of_what_stands_still_cannot_be_told():
    tracks = TurningTracks([TURNING, MOTIONS[1]])
    names, positions, velocities = ["x", "y", "vx", "vy"], np.eye(2, 4), np.eye(4)[2:]
    assert tracks.unobservable(0, positions, names) == ("turn rate",)
    assert tracks.unobservable(0, velocities, names) == ("x", "y", "turn rate")
    assert (
        tracks.unobservable(1, positions, names) == ()
    )  # it is about to move: its mean velocity is not zero
    tracks.start(np.array([[0, 0, 0.01, 0, 0], [0, 0, 0, 0, 0]]), np.zeros((2, 5, 5)))
    assert tracks.unobservable(0, positions, names) == ()
    assert tracks.unobservable(0, velocities, names) == ("x", "y")


def test_no_measurement_of_what_stands_still_tells_its_turn_rate():
    tracks = TurningTracks([TURNING])
    tracks.start(np.zeros((1, 5)), np.eye(5)[None])
    for _ in range(200):
        tracks.see(np.array([0]), np.zeros((1, 2)), np.eye(2, 4), 1e-4 * np.eye(2))
    assert tracks.covariance[0, 4, 4] == 1.0 and tracks.covariance[0, 0, 0] < 1e-4


def test_blind_times_are_the_last_step_before_the_deviation_is_reached():
    tracks = started()
    found = tracks.blind_times(1.5, 20.0, 0.05)
    for i in range(len(MOTIONS)):
        after = [largest_deviation(tracks.ahead([t])[1])[0, i] for t in (found[i], found[i] + 0.05)]
        assert after[0] <= 1.5 < after[1]
    assert (tracks.blind_times(1e9, 1.0, 0.05) == np.inf).all()
    assert (tracks.blind_times(1e-9, 1.0, 0.05) == 0.0).all()


def test_what_is_not_a_number_or_ran_away_ends():
    tracks = started()
    tracks.mean[0, 4] = np.inf
    tracks.mean[1, 4] = np.nan
    with np.errstate(invalid="ignore"):
        assert not np.isfinite(tracks.ahead([0.01, 0.02])[0][:, :2]).any()
        tracks.advance(0.01)
    assert np.isfinite(tracks.mean[2]).all()


def test_only_what_is_told_to_turn_does_and_only_in_the_plane():
    assert type(tracks_of(MOTIONS)) is TurningTracks
    assert type(tracks_of(MOTIONS[2:])) is Tracks
    with pytest.raises(ConfigurationError, match="in the plane: tracks of 2 coordinates, not 3"):
        tracks_of([Motion(np.eye(3), np.inf, np.zeros(3), 0.1)])
