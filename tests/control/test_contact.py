"""Complementarity, and time steps with contacts."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.optimize import nnls

from safe_wrappers.appendix.contact.contact_lcp import contact_step
from safe_wrappers.appendix.contact.lemke import LcpStatus
from safe_wrappers.control.contact.contact import complementarity_residuals
from safe_wrappers.control.contact.impact import effective_mass, normal_impulse, restitution_velocity
from safe_wrappers.errors import ConfigurationError

G = 9.81

# Complementarity ----------------------------------------------------------------------------------------------


def test_residuals_are_zero_for_ideal_contacts_and_name_what_is_missed():
    ideal = complementarity_residuals([0.3, 0.0, 0.0], [0.0, 0.0, 50.0])
    assert all((r == 0.0).all() for r in ideal)
    missed = complementarity_residuals([-0.002, 0.1, 0.0], [40.0, 5.0, -3.0])
    assert missed.penetration.tolist() == [0.002, 0.0, 0.0]
    assert missed.tension.tolist() == [0.0, 0.0, 3.0]
    np.testing.assert_allclose(missed.product, [0.08, 0.5, 0.0])


# One time step ------------------------------------------------------------------------------------------------


def falling_ball(gap, speed, dt, e=0.0, mass=2.0):
    return contact_step([[mass]], [[1.0]], [gap], [speed], [-mass * G], dt, e)


def test_an_open_contact_leaves_free_fall_alone():
    step = falling_ball(gap=1.0, speed=-2.0, dt=0.01)
    assert step.impulse.tolist() == [0.0] and step.velocity[0] == pytest.approx(-2.0 - G * 0.01)
    assert step.gap[0] == pytest.approx(1.0 + 0.01 * step.velocity[0])


def test_a_contact_that_would_be_passed_closes_at_the_end_of_the_step():
    step = falling_ball(gap=0.01, speed=-2.0, dt=0.01)
    assert step.gap[0] == pytest.approx(0.0, abs=1e-15) and step.velocity[0] == pytest.approx(-1.0)
    assert step.impulse[0] > 0.0


@given(st.floats(0.1, 50.0), st.floats(-10.0, -0.01), st.floats(0.0, 1.0))
def test_a_closed_contact_obeys_the_impact_law(mass, speed, e):
    step = contact_step([[mass]], [[1.0]], [0.0], [speed], [0.0], 0.001, e)
    assert step.velocity[0] == pytest.approx(float(restitution_velocity(speed, e)), abs=1e-12)
    assert step.impulse[0] == pytest.approx(float(normal_impulse(mass, speed, e)))


def test_resting_contact_carries_the_weight_and_does_not_hop():
    step = falling_ball(gap=0.0, speed=0.0, dt=0.002, e=0.8)
    assert step.impulse[0] == pytest.approx(2.0 * G * 0.002) and step.velocity[0] == pytest.approx(
        0.0, abs=1e-15
    )


def test_a_bouncing_ball_reaches_its_heights():
    dt, e, height, speed, heights = 1e-4, 0.7, 0.5, 0.0, []
    while len(heights) < 3:
        step = falling_ball(height, speed, dt, e)
        if speed > 0.0 >= step.velocity[0]:
            heights.append(height)
        height, speed = float(step.gap[0]), float(step.velocity[0])
    np.testing.assert_allclose(heights, 0.5 * e ** (2 * np.arange(1, 4)), rtol=5e-3)


def test_a_table_on_four_feet_stands_though_its_forces_are_not_unique():
    # Free body seen from above its feet: heave, pitch, roll; four feet are one too many.
    feet = np.array([[1.0, x, y] for x, y in itertools.product((-0.4, 0.4), (-0.3, 0.3))])
    inertia = np.diag([20.0, 1.5, 2.0])
    step = contact_step(inertia, feet, np.zeros(4), np.zeros(3), [-20.0 * G, 0.0, 0.0], 0.01)
    assert step.status is LcpStatus.SOLVED
    np.testing.assert_allclose(step.velocity, 0.0, atol=1e-12)
    np.testing.assert_allclose(feet.T @ step.impulse, [20.0 * G * 0.01, 0.0, 0.0], atol=1e-12)


def test_a_rod_that_lands_on_one_end_starts_to_turn():
    # Rod of mass m and length l at angle a: the end's normal velocity is y' - l/2 cos(a) w.
    m, length, angle, v = 3.0, 0.8, 0.4, -1.5
    inertia, row = np.diag([m, m * length**2 / 12.0]), np.array([1.0, -0.5 * length * np.cos(angle)])
    mass = m / (1.0 + 3.0 * np.cos(angle) ** 2)
    assert effective_mass(inertia, row) == pytest.approx(mass)
    step = contact_step(inertia, [row], [0.0], [v, 0.0], [0.0, 0.0], 0.001, 0.5)
    assert step.impulse[0] == pytest.approx(-1.5 * mass * v)
    assert row @ step.velocity == pytest.approx(-0.5 * v)


def test_newtons_cradle_is_where_one_law_for_all_impacts_is_wrong():
    # The step solves its own equations: -1/3, 2/3, 2/3. Steel balls, whose impacts have an order, do 0, 0, 1.
    rows = [[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]]
    step = contact_step(np.eye(3), rows, [0.0, 0.0], [1.0, 0.0, 0.0], np.zeros(3), 0.001, 1.0)
    np.testing.assert_allclose(step.velocity, [-1 / 3, 2 / 3, 2 / 3], atol=1e-12)


def test_contacts_that_contradict_each_other_are_reported():
    # Bouncing off the left wall at 1 m/s, with the right wall 0.1 mm away and a step of 10 ms.
    rows = [[1.0], [-1.0]]
    step = contact_step([[1.0]], rows, [0.0, 1e-4], [-1.0], [0.0], 0.01, 1.0)
    assert step.status is LcpStatus.RAY
    assert step.impulse.tolist() == [0.0, 0.0] and step.velocity.tolist() == [-1.0]
    assert contact_step([[1.0]], rows, [0.0, 1e-4], [-1.0], [0.0], 0.01).status is LcpStatus.SOLVED


def machine(seed):
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(1, 6)), int(rng.integers(1, 7))
    root = rng.normal(size=(n, n))
    return rng, root @ root.T + 0.2 * np.eye(n), rng.normal(size=(k, n)), rng.normal(size=n)


@given(st.integers(0, 2**32), st.floats(0.0, 1.0))
@example(27255, 0.0)  # more contacts than joints: two variables may leave at once, but for rounding
def test_impulses_push_and_gain_no_energy(seed, e):
    _, m, j, v = machine(seed)
    sizes = np.linalg.eigvalsh(j @ np.linalg.solve(m, j.T))
    # Directions that are neither independent nor dependent, but for rounding, have no answer to rely on.
    assume(not ((sizes > 1e-13 * sizes[-1]) & (sizes < 1e-9 * sizes[-1])).any())
    step = contact_step(m, j, np.zeros(len(j)), v, np.zeros(len(v)), 0.001, e)
    assert step.status is LcpStatus.SOLVED and (step.impulse >= 0.0).all()
    np.testing.assert_allclose(m @ (step.velocity - v), j.T @ step.impulse, atol=1e-9)
    slack = j @ step.velocity + e * (j @ v)
    assert (slack >= -1e-8).all() and abs(step.impulse @ slack) < 1e-7
    before, after = 0.5 * v @ m @ v, 0.5 * step.velocity @ m @ step.velocity
    assert after <= before * (1.0 + 1e-9) + 1e-9


@given(st.integers(0, 2**32))
def test_an_inelastic_step_is_the_nearest_admissible_velocity(seed):
    # Gauss's principle: least |v - v_free| in the metric of M with J v >= -gap / h, by NNLS on the dual.
    rng, m, j, v = machine(seed)
    gap, f, dt = rng.uniform(0.0, 0.02, len(j)), rng.normal(size=len(v)), 0.01
    step = contact_step(m, j, gap, v, f, dt)
    lower = np.linalg.cholesky(m)
    free = v + dt * np.linalg.solve(m, f)
    g, h = j @ np.linalg.inv(lower).T, -gap / dt - j @ free  # g y >= h, y = L' (v - free): least distance
    u, residual = nnls(np.vstack([g.T, h[None, :]]), np.concatenate([np.zeros(len(v)), [1.0]]))
    r = np.vstack([g.T, h[None, :]]) @ u - np.concatenate([np.zeros(len(v)), [1.0]])
    assert residual > 0.0 and step.status is LcpStatus.SOLVED
    y = -r[:-1] / r[-1]
    np.testing.assert_allclose(step.velocity, free + np.linalg.solve(lower.T, y), atol=1e-6)
    assert (step.gap >= -1e-9).all()


def test_no_contacts_is_a_free_step():
    step = contact_step(np.eye(2), np.zeros((0, 2)), [], [1.0, 2.0], [3.0, 0.0], 0.1)
    assert step.velocity.tolist() == [1.3, 2.0] and step.impulse.shape == step.gap.shape == (0,)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: complementarity_residuals(np.nan, 1.0), "gap must be finite"),
        (lambda: contact_step(np.eye(2), [[1.0]], [0.0], [0.0], [0.0], 0.1), "expected an inertia of shape"),
        (lambda: contact_step(-np.eye(1), [[1.0]], [0.0], [0.0], [0.0], 0.1), "positive definite"),
        (
            lambda: contact_step([[1.0, 0.5], [0.0, 1.0]], [[1.0, 0.0]], [0.0], [0.0] * 2, [0.0] * 2, 0.1),
            "symmetric",
        ),
        (
            lambda: contact_step([[1.0]], [[1.0]], [0.0, 1.0], [0.0], [0.0], 0.1),
            r"gap must have shape \(1,\)",
        ),
        (lambda: contact_step([[1.0]], [[1.0]], [0.0], [0.0], [0.0], 0.0), "step_s must be positive"),
        (
            lambda: contact_step([[1.0]], [[1.0]], [0.0], [0.0], [0.0], 0.1, 1.5),
            "restitution must be between",
        ),
        (lambda: contact_step([[1.0]], [[1.0]], [0.0], [0.0], [0.0], 0.1, "hard"), "restitution is a number"),
    ],
)
def test_bad_input_is_refused_in_words(call, said):
    with pytest.raises(ConfigurationError, match=said):
        call()
