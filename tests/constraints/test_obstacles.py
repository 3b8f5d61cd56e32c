"""Obstacles: signed distance, normal and curvature against differences; Clearance's rows against simulation."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.constraints.obstacles import distances
from safe_wrappers.control.estimation import Motion, Tracks
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.constraint import Constraint

COORDINATE = st.floats(-2, 2).map(lambda v: round(v, 4))
SHAPES = {
    "disc": sw.constraints.Disc([0.2, -0.1], 0.5),
    "sphere": sw.constraints.Sphere([0.2, -0.1, 0.3], 0.5),
    "box": sw.constraints.Box([0.1, 0.2], [0.4, 0.7]),
    "box in space": sw.constraints.Box([0.1, 0.2, -0.3], [0.4, 0.7, 0.2]),
    "wall": sw.constraints.Plane([0.3, 0.1], [1.0, 2.0]),
    "floor": sw.constraints.Plane([0.3, 0.1, 0.2], [0.0, -1.0, 2.0]),
}
DIMENSIONS = {
    "disc": (2, 3),
    "sphere": (3,),
    "box": (2, 3),
    "box in space": (3,),
    "wall": (2, 3),
    "floor": (3,),
}
CASES = [(name, d) for name in SHAPES for d in DIMENSIONS[name]]
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
@given(data=st.data())
def test_distance_is_signed_and_its_gradient_is_the_normal(name, size, data):
    obstacle = SHAPES[name]
    point = np.array([data.draw(COORDINATE) for _ in range(size)])
    near = obstacle.nearest(point, None)
    assert near.distance.shape == (1,) and near.normal.shape == (1, size) and near.velocity.shape == (1, size)
    assert near.distance[0] == pytest.approx(truth(obstacle, point), abs=1e-12)
    assert np.linalg.norm(near.normal[0]) == pytest.approx(1.0)
    step = 1e-6
    gradient = np.array(
        [
            (distance(obstacle, point + step * e) - distance(obstacle, point - step * e)) / (2 * step)
            for e in np.eye(size)
        ]
    )
    if np.linalg.norm(gradient) > 1.0 - 1e-7:  # not on a kink
        np.testing.assert_allclose(near.normal[0], gradient, atol=1e-4)


@every_shape
def test_curvature_is_what_sideways_motion_gains(name, size):
    # The second derivative of the distance along a straight line is curvature times (speed along it)^2.
    obstacle = SHAPES[name]
    rng = np.random.default_rng(0)
    checked = 0
    for _ in range(300):
        point, velocity = rng.uniform(-2, 2, size), rng.normal(size=size)
        near = obstacle.nearest(point, None)
        step = 1e-4
        values = [distance(obstacle, point + s * step * velocity) for s in (-1, 0, 1)]
        wide = [distance(obstacle, point + 2 * s * step * velocity) for s in (-1, 0, 1)]
        second = (values[0] - 2 * values[1] + values[2]) / step**2
        check = (wide[0] - 2 * wide[1] + wide[2]) / (2 * step) ** 2
        if abs(second - check) > 1e-3 * (1 + abs(second)) or near.distance[0] < 0.05:
            continue  # a kink in between, or inside
        approach = near.normal[0] @ velocity
        bend = near.curvature[0] @ velocity**2 - near.curvature[0].max() * approach**2
        assert bend == pytest.approx(second, abs=1e-2 * (1 + abs(second))), (point, velocity)
        checked += 1
    assert checked > 100


class Facts:
    """A plant that publishes attributes and knows nothing else."""

    def __init__(self, **facts):
        self.facts = facts

    def attribute(self, name):
        return self.facts[name]


def test_published_discs_are_read_afresh():
    facts = Facts(where=np.array([[0.0, 0.0], [3.0, 0.0]]), speed=np.array([[1.0, 0.0], [0.0, 0.0]]))
    discs = sw.constraints.Discs("where", 0.5, velocity_attribute="speed")
    near = discs.nearest(np.array([2.0, 0.0]), facts)
    np.testing.assert_allclose(near.distance, [1.5, 0.5])
    np.testing.assert_allclose(near.normal, [[1, 0], [-1, 0]])
    np.testing.assert_allclose(near.velocity, [[1, 0], [0, 0]])
    facts.facts["where"] = np.array([[2.0, 1.0]])
    np.testing.assert_allclose(
        sw.constraints.Discs("where", 0.5).nearest(np.array([2.0, 0.0]), facts).distance, [0.5]
    )
    facts.facts["where"] = np.zeros((0, 2))
    assert sw.constraints.Discs("where", 0.5).nearest(np.array([2.0, 0.0]), facts).distance.shape == (0,)
    facts.facts["where"] = np.zeros(3)
    with pytest.raises(ConfigurationError, match=r"where must have shape \(k, 2\) or \(k, 3\), got \(3,\)"):
        sw.constraints.Discs("where", 0.5).nearest(np.array([2.0, 0.0]), facts)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: sw.constraints.Disc([0, 0], -1), "radius must be a finite number > 0 in m, got -1"),
        (lambda: sw.constraints.Disc([0, 0, 0], 1), "center must be 2 finite numbers, got"),
        (lambda: sw.constraints.Box([0, 0], [1, 1, 1]), "half_size must be 2 finite numbers"),
        (lambda: sw.constraints.Plane([0, 0], [1]), "normal must be 2 finite numbers"),
        (lambda: sw.constraints.Clearance(["wall"], braking=1), "expected an obstacle .* got 'wall'"),
    ],
)
def test_constructors_refuse_nonsense(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()


# Moving obstacles ---------------------------------------------------------------------------------------------


class Chaser(gym.Env):
    """A cart at rest on a line with a disc that drives at it; the disc's place is published."""

    dt = 0.1
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def __init__(self, latency_steps=0):
        self.latency_steps = latency_steps

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.queue = [0.0] * self.latency_steps
        self.state = np.zeros(4)  # x, y, vx, vy
        self.discs, self.speeds = np.array([[3.0, 0.0]]), np.array([[-0.4, 0.0]])
        self.elapsed, self.closest = 0.0, np.inf
        return self.state[:2].astype(np.float32), {}

    def step(self, action):
        self.queue.append(float(np.asarray(action)[0]))
        a = self.queue.pop(0)
        for t in np.linspace(0.0, self.dt, 11)[1:]:
            x = self.state[0] + self.state[2] * t + 0.5 * a * t**2
            self.closest = min(self.closest, abs(self.discs[0, 0] + self.speeds[0, 0] * t - x) - 0.5)
        self.state = self.state + np.array(
            [self.state[2] * self.dt + 0.5 * a * self.dt**2, 0.0, a * self.dt, 0.0]
        )
        self.discs = self.discs + self.speeds * self.dt
        return self.state[:2].astype(np.float32), 0.0, False, False, {}


def chase(obstacle, policy, delay_s=0.0):
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[2], x[3], 0.0, 0.0]),
        g=lambda x: np.array([[0.0], [0.0], [1.0], [0.0]]),
        state=lambda env: env.state,
        control_dt=0.1,
        delay_s=delay_s,
    )
    clear = sw.constraints.Clearance([obstacle], braking=1.0, position=[0, 1], velocity=[2, 3], margin=1e-3)
    env = sw.CBFActionFilter(Chaser(round(delay_s / 0.1)), [clear], plant=plant)
    env.reset(seed=0)
    for _ in range(80):
        env.step(np.array([policy]))
    return env.unwrapped.closest


@pytest.mark.parametrize("policy", [1.0, 0.0])
def test_a_published_moving_disc_is_evaded(policy):
    closest = chase(sw.constraints.Discs("discs", 0.5, velocity_attribute="speeds"), policy)
    assert 0.0 <= closest < 0.05
    blind = chase(sw.constraints.Discs("discs", 0.5), policy)
    assert blind < 0.0  # taken for standing still it runs the cart over: the test has teeth


OBSTACLES = [
    sw.constraints.Disc([0.3, -0.2], 0.4),
    sw.constraints.Sphere([0.3, -0.2, 0.1], 0.4),
    sw.constraints.Plane([0.1, 0.0, 0.0], [1.0, 2.0, 0.5]),
    sw.constraints.Plane([0.1], [1.0]),
    sw.constraints.Box([0.0, 0.1], [0.5, 0.3]),
    sw.constraints.Box([0.0, 0.1, 0.2], [0.5, 0.3, 0.1]),
    sw.constraints.Discs("centers", 0.3),
]


class Publishes:
    def attribute(self, name):
        return np.array([[0.0, 0.5], [-0.4, 0.1]])


@pytest.mark.parametrize("obstacle", OBSTACLES, ids=lambda o: f"{type(o).__name__}{len(o.__dict__)}")
def test_distances_of_many_points_are_those_of_each(obstacle):
    points = np.random.default_rng(0).uniform(-1.0, 1.0, size=(200, 3))
    one_by_one = np.stack([obstacle.nearest(point, Publishes()).distance for point in points])
    assert (one_by_one < 0.0).any() and (one_by_one > 0.0).any()
    np.testing.assert_allclose(distances(obstacle, points, Publishes()), one_by_one, atol=1e-12)


# TrackedDiscs against points sampled all over the bounds that they stand for


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
def test_the_distance_is_that_of_the_box_around_all_places_and_never_more(seed, sigmas, d):
    tracks = some_tracks(seed, d)
    discs, plant = sw.constraints.TrackedDiscs(RADIUS, sigmas), Holding(tracks)
    point = np.random.default_rng(seed + 1).normal(size=d) * 4.0
    found = discs.nearest(point, plant)
    places = rims(tracks, sigmas, [1e-12])[0]
    away = np.linalg.norm(point - places, axis=-1).min(axis=1)
    boxed = np.linalg.norm(np.clip(point, places.min(axis=1), places.max(axis=1)) - point, axis=-1)
    outside = found.distance + RADIUS > 0.0
    assert (found.distance <= away - RADIUS + 1e-7)[outside].all()
    loose = 1e-4 if d == 2 else 0.15
    assert (found.distance + RADIUS >= (1 - loose) * boxed - loose)[outside].all()
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-12)
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
