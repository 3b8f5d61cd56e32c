"""Obstacles: signed distance, normal and curvature against differences, tracked ones against sampled bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.control.estimation import Motion, Tracks
from safe_wrappers.errors import ConfigurationError

SHAPES = {
    "disc": sw.constraints.Disc([0.2, -0.1], 0.5),
    "sphere": sw.constraints.Sphere([0.2, -0.1, 0.3], 0.5),
    "box": sw.constraints.Box([0.1, 0.2], [0.4, 0.7]),
    "box in space": sw.constraints.Box([0.1, 0.2, -0.3], [0.4, 0.7, 0.2]),
    "wall": sw.constraints.Plane([0.3, 0.1], [1.0, 2.0]),
    "floor": sw.constraints.Plane([0.3, 0.1, 0.2], [0.0, -1.0, 2.0]),
}
FLAT = "disc", "box", "wall"
CASES = [(name, size) for name in SHAPES for size in (2, 3) if size == 3 or name in FLAT]
every_shape = pytest.mark.parametrize(("name", "size"), CASES)


def distance(obstacle, point):
    return float(obstacle.nearest(np.asarray(point, float), None).distance[0])


def truth(obstacle, point):
    """Distance to the surface by sampling it (negative inside), with no use of the library's formulas."""
    d = len(getattr(obstacle, "center", getattr(obstacle, "point", None)))
    p = np.asarray(point)[:d]
    if isinstance(obstacle, sw.constraints.Plane):
        n = np.array(obstacle.normal) / np.linalg.norm(obstacle.normal)
        return (p - obstacle.point) @ n
    offset = p - obstacle.center
    if isinstance(obstacle, sw.constraints.Box):
        half = np.array(obstacle.half_size)
        closest = np.clip(offset, -half, half)
        if (closest != offset).any():
            return np.linalg.norm(offset - closest)
        return -(half - np.abs(offset)).min()
    return np.linalg.norm(offset) - obstacle.radius


@every_shape
def test_distance_is_signed_and_normal_and_curvature_are_its_derivatives(name, size):
    obstacle, rng, checked = SHAPES[name], np.random.default_rng(0), 0
    for _ in range(300):
        point, velocity = rng.uniform(-2, 2, size), rng.normal(size=size)
        near = obstacle.nearest(point, None)
        assert near.distance.shape == (1,) and near.normal.shape == near.velocity.shape == (1, size)
        assert near.distance[0] == pytest.approx(truth(obstacle, point), abs=1e-12)
        assert np.linalg.norm(near.normal[0]) == pytest.approx(1.0)
        along = {s: distance(obstacle, point + 1e-4 * s * velocity) for s in (-2, -1, 0, 1, 2)}
        second, wide = ((along[s] - 2 * along[0] + along[-s]) / (s * 1e-4) ** 2 for s in (1, 2))
        if abs(second - wide) > 1e-3 * (1 + abs(second)):
            continue  # a kink in between
        approach = near.normal[0] @ velocity
        assert approach == pytest.approx((along[1] - along[-1]) / 2e-4, abs=1e-4)
        if near.distance[0] > 0.05:  # what sideways motion gains: curvature times (speed along it)^2
            bend = near.curvature[0] @ velocity**2 - near.curvature[0].max() * approach**2
            assert bend == pytest.approx(second, abs=1e-2 * (1 + abs(second)))
            checked += 1
    assert checked > 100


@pytest.mark.parametrize("kind", [sw.constraints.Disc, sw.constraints.Sphere])
def test_at_the_very_centre_there_is_a_way_out(kind):
    obstacle = kind([0.3, -0.2, 0.1][: kind.coordinates], 0.5)
    near = obstacle.nearest(np.array(obstacle.center), None)
    assert near.distance[0] == -0.5 and np.linalg.norm(near.normal[0]) == 1.0


class Facts:
    """A plant that publishes attributes and knows nothing else."""

    control_dt, delay_s = 0.04, 0.0

    def __init__(self, **facts):
        self.facts = facts

    def attribute(self, name):
        return self.facts[name]


def test_published_discs_are_read_afresh_and_move_as_published():
    facts, point = Facts(where=np.array([[0.0, 0.0], [3.0, 0.0]]), speed=np.eye(2)), np.array([2.0, 0.0])
    discs = sw.constraints.Discs("where", 0.5, velocity_attribute="speed")
    near = discs.nearest(point, facts)
    np.testing.assert_allclose(near.normal, [[1, 0], [-1, 0]])
    np.testing.assert_allclose(near.velocity, np.eye(2))
    still = sw.constraints.Discs("where", 0.5)
    for where, left in (
        ([[0.0, 0.0], [3.0, 0.0]], [1.5, 0.5]),
        ([[2.0, 1.0]], [0.5]),
        (np.zeros((0, 2)), []),
    ):
        facts.facts["where"] = np.array(where)
        np.testing.assert_allclose(still.nearest(point, facts).distance, left)
    for where, words in (
        (np.zeros(3), r"shape \(k, 2\) or \(k, 3\), got \(3,\)"),
        (np.zeros((1, 3)), "cannot meet"),
    ):
        facts.facts["where"] = where
        with pytest.raises(ConfigurationError, match=words):
            still.nearest(point, facts)


# TrackedDiscs against points sampled all over the bounds that they stand for


RADIUS = 0.4


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


@given(seed=st.integers(0, 10**6), sigmas=st.sampled_from([0.0, 1.0, 3.0]), d=st.sampled_from([2, 3]))
def test_the_distance_is_that_of_the_box_around_all_places_which_come_no_nearer_than_foretold(
    seed, sigmas, d
):
    tracks, horizon = some_tracks(seed, d), 1.3
    discs = sw.constraints.TrackedDiscs(RADIUS, sigmas, horizon_s=horizon)
    point = np.random.default_rng(seed + 1).normal(size=d) * 4.0
    found = discs.nearest(point, Facts(tracking=tracks))
    outside = found.distance + RADIUS > 0.0
    places = rims(tracks, sigmas, [1e-12])[0]
    away = np.linalg.norm(point - places, axis=-1).min(axis=1)
    boxed = np.linalg.norm(np.clip(point, places.min(axis=1), places.max(axis=1)) - point, axis=-1)
    assert (found.distance <= away - RADIUS + 1e-7)[outside].all()
    loose = 1e-4 if d == 2 else 0.15
    assert (found.distance + RADIUS >= (1 - loose) * boxed - loose)[outside].all()
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-12)
    assert not found.curvature.any()
    # The growth is looked at at every third of these times; it is smooth: in between it is more by a little.
    times = horizon * np.array([1e-4, 0.02, 0.05, 0.1, 0.17, 0.2, 0.25, 0.4, 0.45, 0.5, 0.7, 0.85, 1.0])
    away = np.linalg.norm(point - rims(tracks, sigmas, times.tolist(), 400), axis=-1).min(axis=-1)
    way = times[:, None] * (found.velocity * found.normal).sum(axis=1)
    assert (away[::3] >= found.distance + RADIUS - way[::3] - 1e-6)[:, outside].all()
    assert (away >= found.distance + RADIUS - way - 0.02 * (1.0 + np.abs(way)))[:, outside].all()
