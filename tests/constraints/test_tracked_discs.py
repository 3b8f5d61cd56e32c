"""TrackedDiscs against points sampled all over the bounds that they stand for."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.control.estimation.tracks import Motion, Tracks
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.constraint import Constraint

RADIUS = 0.4


class Holding:
    """As much of a plant as obstacles ask for."""

    control_dt, delay_s = 0.04, 0.0

    def __init__(self, tracks):
        self.tracks = tracks

    def attribute(self, name):
        assert name == "tracking"
        return self.tracks


def some_tracks(seed, d=2, n=3):
    rng = np.random.default_rng(seed)
    motions = []
    for _ in range(n):
        root = rng.normal(size=(d, d)) * rng.uniform(0, 1)
        motions.append(
            Motion(root @ root.T, rng.choice([np.inf, 0.3, 2.0]), rng.normal(size=d) * rng.uniform(0, 2))
        )
    tracks = Tracks(motions)
    root = rng.normal(size=(n, 2 * d, 2 * d)) * rng.uniform(0.0, 0.5, (n, 1, 1))
    if seed % 3 == 0:
        root[:, d - 1] = 0.0  # sure along one axis
    tracks.start(rng.normal(size=(n, 2 * d)) * 2.0, root @ root.swapaxes(1, 2))
    return tracks


def rims(tracks, sigmas, times, count=1500):
    """Points all around the bounds of the centres at some times, shape (times, tracks, count, d)."""
    positions, covariances = tracks.ahead(times)
    d = positions.shape[-1]
    if d == 2:
        angle = np.linspace(0, 2 * np.pi, count)
        ball = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        ball = np.random.default_rng(0).normal(size=(count, d))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(covariances)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return positions[:, :, None] + sigmas * (ball @ roots.swapaxes(-1, -2))


cases = given(seed=st.integers(0, 10**6), sigmas=st.sampled_from([0.0, 1.0, 3.0]), d=st.sampled_from([2, 3]))


@cases
def test_the_distance_is_that_of_the_nearest_place_and_never_more(seed, sigmas, d):
    tracks = some_tracks(seed, d)
    discs, plant = sw.constraints.TrackedDiscs(RADIUS, sigmas), Holding(tracks)
    point = np.random.default_rng(seed + 1).normal(size=d) * 4.0
    found = discs.nearest(point, plant)
    away = np.linalg.norm(point - rims(tracks, sigmas, [1e-12])[0], axis=-1).min(axis=1)
    outside = found.distance + RADIUS > 0.0
    assert (found.distance <= away - RADIUS + 1e-7)[outside].all()
    loose = 1e-4 if d == 2 else 0.15
    assert (found.distance + RADIUS >= (1 - loose) * away - loose)[outside].all()
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(discs.distances(point[None], plant)[0], found.distance, atol=1e-12)
    assert not found.curvature.any()


@cases
def test_nothing_comes_nearer_faster_than_the_velocity_says(seed, sigmas, d):
    tracks = some_tracks(seed, d)
    horizon = 1.3
    discs = sw.constraints.TrackedDiscs(RADIUS, sigmas, horizon_s=horizon)
    point = np.random.default_rng(seed + 1).normal(size=d) * 4.0
    found = discs.nearest(point, Holding(tracks))
    times = (horizon * np.array([1e-4, 0.02, 0.05, 0.1, 0.17, 0.25, 0.4, 0.5, 0.75, 1.0])).tolist()
    away = np.linalg.norm(point - rims(tracks, sigmas, times, 400), axis=-1).min(axis=-1)
    approach = (found.velocity * found.normal).sum(axis=1)
    promised = found.distance + RADIUS - np.array(times)[:, None] * approach
    outside = found.distance + RADIUS > 0.0
    at_samples = [0, 3, 5, 7, 9]
    assert (away[at_samples] >= promised[at_samples] - 1e-6)[:, outside].all()
    # Between the times that are looked at, by at most this much of the way: the growth is smooth.
    assert (away >= promised - 0.02 * (1.0 + np.abs(times * 1)[:, None] * np.abs(approach)))[:, outside].all()


def test_what_brakes_comes_as_fast_as_it_does_now():
    # At 2 m/s towards the point and soon back to rest: over the horizon slow, at this moment not.
    tracks = Tracks([Motion(np.zeros((2, 2)), 0.2, np.zeros(2))])
    tracks.start(np.array([[0.0, 0.0, 2.0, 0.0]]), np.zeros((1, 4, 4)))
    found = sw.constraints.TrackedDiscs(RADIUS, horizon_s=2.0).nearest(np.array([3.0, 0.0]), Holding(tracks))
    assert found.velocity[0, 0] == pytest.approx(2.0, rel=1e-2)


def test_the_velocity_across_is_the_estimate_s():
    tracks = some_tracks(5)
    found = sw.constraints.TrackedDiscs(RADIUS).nearest(np.array([4.0, 4.0]), Holding(tracks))
    across = np.stack([-found.normal[:, 1], found.normal[:, 0]], axis=1)
    np.testing.assert_allclose(
        (found.velocity * across).sum(1), (tracks.velocities * across).sum(1), atol=1e-12
    )


def test_what_is_sure_to_stay_in_its_lane_is_only_uncertain_along_it():
    tracks = Tracks([Motion(np.diag([0.1, 0.0]), np.inf, np.zeros(2))])
    tracks.start(np.zeros((1, 4)), np.diag([0.25, 0.0, 0.1, 0.0])[None])
    discs, plant = sw.constraints.TrackedDiscs(RADIUS, 3.0), Holding(tracks)
    beside, before = (discs.nearest(np.array(p), plant).distance[0] for p in ([0.7, 1.0], [2.5, 0.0]))
    assert beside == pytest.approx(1.0 - RADIUS, abs=1e-6) and before == pytest.approx(1.0 - RADIUS, abs=1e-6)


@pytest.mark.parametrize("sigmas", [0.0, 2.0])
def test_boxes_hold_the_bounds_and_touch_them(sigmas):
    tracks = some_tracks(7)
    times = np.array([0.0, 0.4, 2.0])
    centers, halves = sw.constraints.TrackedDiscs(RADIUS, sigmas).boxes(Holding(tracks), times)
    rim = rims(tracks, sigmas, times.tolist())
    np.testing.assert_allclose(rim.max(axis=2), centers + halves, atol=1e-4)
    np.testing.assert_allclose(rim.min(axis=2), centers - halves, atol=1e-4)


def test_a_flat_track_stands_upright_in_space_and_the_other_way_round_it_is_refused():
    flat = some_tracks(1, d=2)
    plane, space = (
        sw.constraints.TrackedDiscs(RADIUS).nearest(np.array(p), Holding(flat))
        for p in ([3.0, 1.0], [3.0, 1.0, 9.0])
    )
    np.testing.assert_allclose(plane.distance, space.distance)
    assert not space.normal[:, 2].any()
    with pytest.raises(ConfigurationError, match="3-dimensional tracks cannot meet a 2-dim"):
        sw.constraints.TrackedDiscs(RADIUS).nearest(np.zeros(2), Holding(some_tracks(1, d=3)))


def test_estimates_that_are_no_numbers_are_told_as_such():
    tracks = some_tracks(1)
    tracks.mean[0, 0] = np.nan
    discs, plant = sw.constraints.TrackedDiscs(RADIUS), Holding(tracks)
    assert np.isnan(discs.nearest(np.zeros(2), plant).distance).all()
    assert np.isnan(discs.distances(np.zeros((4, 2)), plant)).all()


def test_what_is_wrong_is_refused():
    for words, bad in (
        ("radius", {"radius": 0.0}),
        ("sigmas", {"radius": 1.0, "sigmas": -1}),
        ("horizon_s", {"radius": 1.0, "horizon_s": 0.0}),
    ):
        with pytest.raises(ConfigurationError, match=words):
            sw.constraints.TrackedDiscs(**bad)
    with pytest.raises(ConfigurationError, match=r"holds no tracks but str.*OcclusionPenalty"):
        sw.constraints.TrackedDiscs(0.3).nearest(np.zeros(2), Holding("tracks"))


def test_in_a_clearance_it_keeps_a_machine_out_and_what_is_missing_is_named():
    def clearance(**options):
        return sw.constraints.Clearance(
            [sw.constraints.TrackedDiscs(0.4, **options)],
            bodies=["robot"],
            braking=3.0,
            radius=0.2,
            margin=0.02,
        )

    assert isinstance(clearance(), Constraint)
    bare = sw.CBFActionFilter(gym.make("OccludedCrossing-v0"), [clearance()])
    with pytest.raises(UnknownNameError, match="no attribute 'tracking'"):
        bare.reset(seed=0)
    env = sw.CBFActionFilter(gym.make("OccludedCrossing-v0"), [clearance(attribute="car_tracks")])
    # Cars that stand in a row across the way: it stops before them.
    row = {"agent": [0.0, -2.9, 0.0], "cars": [[-0.9, 0], [0.0, 0], [0.9, 0], [-0.9, 0], [0, 0], [0.9, 0]]}
    pillars = [[-3, -1.9], [3, -1.9], [-3, 1.9], [3, 1.9]]
    env.reset(seed=0, options={"layout": {**row, "pillars": pillars}})
    raw, changed = env.unwrapped, 0
    for _ in range(100):
        state = raw.data.qpos.copy(), raw.data.qvel.copy()
        state[0][3:], state[1][3:] = [-0.9, 0, 0.9] * 2, 0.0  # they would drive on
        raw.set_state(*state)
        info = env.step(np.array([0.0, 1.0, 0.0]))[4]
        changed += info["cbf/intervened"]
    assert changed > 20 and raw.agent_position[1] < -0.8 - 0.55
