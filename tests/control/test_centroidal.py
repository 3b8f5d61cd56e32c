"""Centroidal momentum against textbook bodies, a simulated swarm, and a change of the observer's velocity."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.legged.centroidal import centroidal_momentum
from safe_wrappers.errors import ConfigurationError


def bodies(seed, n=4):
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(n, 3, 3))
    return {
        "masses": rng.uniform(0.1, 3.0, n),
        "positions": rng.normal(size=(n, 3)),
        "velocities": rng.normal(size=(n, 3)),
        "inertias": roots @ np.swapaxes(roots, 1, 2),
        "angular_velocities": rng.normal(size=(n, 3)),
    }


def test_a_dumbbell_that_turns():
    # Two points 2 r apart, turning with w about their middle, which moves.
    r, w, v = 0.3, 2.0, np.array([1.0, -2.0, 0.5])
    arms = np.array([[r, 0, 0], [-r, 0, 0]])
    found = centroidal_momentum(
        [1.5, 1.5],
        arms + np.array([5, 6, 7]),
        v + np.cross([0, 0, w], arms),
        np.zeros((2, 3, 3)),
        np.tile([0, 0, w], (2, 1)),
    )
    assert found.mass == 3.0
    assert found.com == pytest.approx([5, 6, 7])
    assert found.linear == pytest.approx(3.0 * v)
    assert found.angular == pytest.approx([0.0, 0.0, 2 * 1.5 * r * r * w])


def test_a_top_has_its_own_momentum_only():
    inertia = np.diag([0.1, 0.2, 0.3])
    found = centroidal_momentum([2.0], [[1.0, 1, 1]], [[3.0, 0, 0]], [inertia], [[0.0, 4.0, 5.0]])
    assert found.angular == pytest.approx([0.0, 0.8, 1.5])


@given(st.integers(0, 1000), st.tuples(*[st.floats(-10, 10)] * 3))
def test_angular_momentum_about_the_centre_of_mass_is_the_same_for_every_observer(seed, shift):
    given_bodies = bodies(seed)
    moved = given_bodies | {"velocities": given_bodies["velocities"] + shift}
    one, other = centroidal_momentum(**given_bodies), centroidal_momentum(**moved)
    assert other.angular == pytest.approx(one.angular, abs=1e-9)
    assert other.linear == pytest.approx(one.linear + one.mass * np.array(shift), abs=1e-9)
    # About a fixed point it is what moves with the centre of mass, and this (König).
    total = np.cross(given_bodies["positions"], given_bodies["masses"][:, None] * given_bodies["velocities"])
    spin = np.einsum("nij,nj->i", given_bodies["inertias"], given_bodies["angular_velocities"])
    assert total.sum(axis=0) + spin == pytest.approx(np.cross(one.com, one.linear) + one.angular)


def test_forces_from_outside_and_nothing_else_change_the_momentum():
    rng = np.random.default_rng(3)
    masses, x, v = rng.uniform(0.5, 2.0, 4), rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    outside, gravity = rng.normal(size=(2, 3)), np.array([0.0, 0.0, -9.81])

    def acceleration(x):
        total = np.zeros((4, 3))
        total[:2] += outside
        for i in range(4):
            for j in range(i):  # stiff springs between all of them
                apart = x[i] - x[j]
                pull = -80.0 * (np.linalg.norm(apart) - 1.0) * apart / np.linalg.norm(apart)
                total[i] += pull
                total[j] -= pull
        return total / masses[:, None] + gravity

    def momentum(x, v):
        found = centroidal_momentum(masses, x, v, np.zeros((4, 3, 3)), np.zeros((4, 3)))
        return found, np.concatenate([found.linear, found.angular])

    dt = 1e-5
    now, h = momentum(x, v)
    linear = outside.sum(axis=0) + now.mass * gravity  # which has no moment about the centre of mass
    angular = np.cross(x[:2] - now.com, outside).sum(axis=0)
    a = acceleration(x)
    _, later = momentum(x + dt * v + 0.5 * dt * dt * a, v + dt * acceleration(x + 0.5 * dt * v))
    assert (later - h) / dt == pytest.approx(np.concatenate([linear, angular]), abs=2e-3)


def test_batches():
    stacked = {name: np.stack([bodies(0)[name], bodies(1)[name]]) for name in bodies(0)}
    both = centroidal_momentum(**stacked)
    for i in range(2):
        assert both.angular[i] == pytest.approx(centroidal_momentum(**bodies(i)).angular)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"masses": [1.0, -1.0, 1.0, 1.0]}, "masses"),
        ({"masses": [0.0] * 4}, "masses"),
        ({"masses": [1.0] * 3}, "positions"),
        ({"masses": 1.0}, "expected masses"),
        ({"velocities": [[math.nan] * 3] * 4}, "velocities must be finite"),
        ({"inertias": np.eye(3)}, "inertias"),
        ({"inertias": [["x"]]}, "inertias is a number"),
    ],
)
def test_bad_input_is_refused(change, said):
    with pytest.raises(ConfigurationError, match=said):
        centroidal_momentum(**(bodies(0) | change))
