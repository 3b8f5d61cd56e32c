"""Centroidal momentum against textbook bodies, a simulated swarm, and a change of the observer's velocity."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.appendix.legged.centroidal import (
    centroidal_bias_rate,
    centroidal_momentum_matrix,
    momentum_rate,
)
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


@given(st.integers(0, 1000))
def test_the_matrix_times_the_velocities_is_the_momentum(seed):
    rng = np.random.default_rng(seed)
    linear, angular, qvel = rng.normal(size=(4, 3, 7)), rng.normal(size=(4, 3, 7)), rng.normal(size=7)
    b = bodies(seed)
    a = centroidal_momentum_matrix(b["masses"], b["positions"], b["inertias"], linear, angular)
    found = centroidal_momentum(b["masses"], b["positions"], linear @ qvel, b["inertias"], angular @ qvel)
    assert a.shape == (6, 7)
    assert a @ qvel == pytest.approx(np.concatenate([found.linear, found.angular]))


def test_a_top_on_a_turntable_needs_the_gyroscopic_moment():
    # Spinning about its own axis with s while that axis is turned with w: the momentum turns, rate w x I s.
    s, w, inertia = 50.0, 2.0, np.diag([0.2, 0.1, 0.1])
    spin = np.array([s, 0.0, w])
    # The spin's axis is carried along: its rate of change is w x (s e_x).
    drift = np.cross([0.0, 0.0, w], [s, 0.0, 0.0])
    rate = centroidal_bias_rate([1.0], [[0, 0, 0]], [inertia], [spin], [[0, 0, 0]], [drift])
    # The principal axes turn with the table: d(I spin)/dt = w x (I spin).
    assert rate[3:] == pytest.approx(np.cross([0.0, 0.0, w], inertia @ spin))
    assert rate[:3] == pytest.approx([0.0, 0.0, 0.0])


def test_a_carousel_pulls_inwards_and_keeps_its_spin():
    w, r = 3.0, 0.5
    positions = np.array([[r, 0, 0], [0, 0, 0.0]])
    rate = centroidal_bias_rate(
        [2.0, 0.0],
        positions,
        np.zeros((2, 3, 3)),
        np.tile([0, 0, w], (2, 1)),
        [[-w * w * r, 0, 0], [0, 0, 0]],
        np.zeros((2, 3)),
    )
    assert rate == pytest.approx([-2.0 * w * w * r, 0, 0, 0, 0, 0])


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
    linear, angular = momentum_rate(now.mass, now.com, gravity, x[:2], outside)
    a = acceleration(x)
    _, later = momentum(x + dt * v + 0.5 * dt * dt * a, v + dt * acceleration(x + 0.5 * dt * v))
    assert (later - h) / dt == pytest.approx(np.concatenate([linear, angular]), abs=2e-3)
    without = momentum_rate(now.mass, now.com, np.zeros(3), x[:2], outside)
    assert linear - without[0] == pytest.approx(masses.sum() * gravity)
    assert angular == pytest.approx(without[1])  # gravity has no moment about the centre of mass


def test_moments_of_patches_count_and_no_contact_leaves_the_fall():
    linear, angular = momentum_rate(2.0, [0, 0, 1.0], [0, 0, -9.81], np.zeros((0, 3)), np.zeros((0, 3)))
    assert linear == pytest.approx([0, 0, -19.62])
    assert angular == pytest.approx([0, 0, 0])
    _, turned = momentum_rate(2.0, [0, 0, 1.0], [0, 0, -9.81], [[1.0, 0, 1.0]], [[0, 0, 5.0]], [[0, 0, 0.5]])
    assert turned == pytest.approx([0, -5.0, 0.5])


def test_batches():
    stacked = {name: np.stack([bodies(0)[name], bodies(1)[name]]) for name in bodies(0)}
    both = centroidal_momentum(**stacked)
    for i in range(2):
        assert both.angular[i] == pytest.approx(centroidal_momentum(**bodies(i)).angular)
    jac = np.random.default_rng(0).normal(size=(2, 4, 3, 5))
    a = centroidal_momentum_matrix(stacked["masses"], stacked["positions"], stacked["inertias"], jac, jac)
    assert a.shape == (2, 6, 5)
    rate = centroidal_bias_rate(
        stacked["masses"],
        stacked["positions"],
        stacked["inertias"],
        stacked["angular_velocities"],
        jac[..., 0],
        jac[..., 1],
    )
    assert rate.shape == (2, 6)
    linear, angular = momentum_rate(both.mass, both.com, [0, 0, -9.81], stacked["positions"], jac[..., 0])
    assert linear.shape == angular.shape == (2, 3)


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


def test_flat_points_are_refused():
    with pytest.raises(ConfigurationError, match="points and forces"):
        momentum_rate(1.0, [0, 0, 0], [0, 0, 0], [1.0, 0, 0], [1.0, 0, 0])
