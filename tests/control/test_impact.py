"""Impacts: against integration of the mass on its spring, MuJoCo drops, and balances of momentum and energy."""

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from safe_wrappers.control.contact.contact import series_stiffness
from safe_wrappers.control.contact.impact import (
    attenuation_after_delay,
    braked_deflection,
    braked_peak_force,
    effective_mass,
    normal_impulse,
    peak_deflection,
    peak_force,
    reduced_mass,
    restitution_velocity,
    speed_limit,
    time_to_peak,
)
from safe_wrappers.errors import ConfigurationError

speeds, masses = st.floats(0.01, 10.0), st.floats(0.05, 100.0)
stiffnesses, brakes = st.floats(100.0, 1e6), st.floats(0.0, 300.0)
MACHINE = (0.8, 12.0, 25_000.0)


def integrated(v, m, k, a=0.0, latency=0.0, start=0.0):
    """Time and depth of the first peak, from the equation of motion; the brake comes on at `latency`."""

    def peak(t, x):
        return x[1]

    peak.terminal, peak.direction = True, -1
    now, state = 0.0, [start, v]
    period = 2.0 * np.pi * np.sqrt(m / k)
    for braking, until in ((0.0, latency), (a, latency + 10.0 * period)):
        if until <= now:
            continue
        done = solve_ivp(
            lambda t, x, braking=braking: [x[1], -k / m * x[0] - braking],
            (now, until),
            state,
            "DOP853",
            events=peak,
            rtol=1e-11,
            atol=1e-14,
            max_step=period / 8.0,
        )
        if len(done.t_events[0]):
            return done.t_events[0][0], done.y_events[0][0][0]
        now, state = until, done.y[:, -1]
    raise AssertionError("no peak")


# The elastic part: a mass on a spring -----------------------------------------------------------------------


@settings(max_examples=30)
@given(speeds, masses, stiffnesses)
def test_the_peak_is_the_oscillators(v, m, k):
    time, depth = integrated(v, m, k)
    assert peak_deflection(v, m, k) == pytest.approx(depth, rel=1e-8)
    assert peak_force(v, m, k) == pytest.approx(k * depth, rel=1e-8)
    assert time_to_peak(m, k) == pytest.approx(time, rel=1e-8)


@given(speeds, masses, stiffnesses, brakes, st.floats(0.0, 1.6))
def test_a_brake_that_comes_late_is_the_integrated_one(v, m, k, a, share):
    latency = share * time_to_peak(m, k)
    assume(abs(share - 1.0) > 1e-6)
    _, depth = integrated(v, m, k, a, latency)
    assert braked_deflection(v, m, k, a, latency) == pytest.approx(depth, rel=1e-7)
    assert braked_peak_force(v, m, k, a, latency) == pytest.approx(k * depth, rel=1e-7)


@settings(max_examples=30)
@given(st.floats(0.0, 5.0), masses, stiffnesses, st.floats(-100.0, -0.1), st.floats(0.0, 0.9))
def test_a_push_that_goes_on_is_a_brake_below_zero(v, m, k, a, share):
    assume(v > 1e-3 or share == 0.0)
    latency = share * time_to_peak(m, k)
    _, depth = integrated(v, m, k, a, latency)
    assert braked_deflection(v, m, k, a, latency) == pytest.approx(depth, rel=1e-6)


@given(speeds, masses, stiffnesses, st.floats(-100.0, 300.0), st.floats(0.0, 3.0), st.floats(0.0, 1.6))
def test_a_contact_that_is_deflected_already_goes_on_from_there(v, m, k, a, depth, share):
    unbraked = v * np.sqrt(m / k)
    start = depth * unbraked
    quarter = np.arctan2(1.0, depth) * np.sqrt(m / k)  # till its own peak
    latency = share * quarter
    assume(abs(share - 1.0) > 1e-3)
    _, deep = integrated(v, m, k, a, latency, start)
    assert braked_deflection(v, m, k, a, latency, start) == pytest.approx(deep, rel=1e-6)
    assert braked_peak_force(v, m, k, a, latency, start) == pytest.approx(k * deep, rel=1e-6)


def test_a_spring_that_holds_a_push_stays_where_it_is():
    push, k, m = 50.0, 1e4, 2.0
    assert braked_peak_force(0.0, m, k, -push / m, deflection=push / k) == pytest.approx(push, rel=1e-12)
    # Let go from half of it, it swings to as far beyond.
    assert braked_peak_force(0.0, m, k, -push / m, deflection=0.5 * push / k) == pytest.approx(1.5 * push)


@given(speeds, masses, stiffnesses, brakes)
def test_a_brake_from_the_touch_on_solves_the_appendix_quadratic(v, m, k, a):
    x = braked_deflection(v, m, k, a)
    terms = x**2, 2.0 * m * a / k * x, -m * v**2 / k
    assert x > 0.0 and abs(sum(terms)) <= 1e-12 * abs(terms[2])


def test_a_very_strong_brake_loses_no_digits():
    # Rigid in comparison: v^2 / 2a. The difference of roots as the appendix prints it has lost every digit here.
    assert braked_deflection(1e-3, 1.0, 1e-2, 1e8) == pytest.approx(5e-15, rel=1e-9)


@given(speeds, masses, stiffnesses, st.floats(0.1, 300.0))
def test_braking_that_starts_at_the_peak_or_later_is_too_late(v, m, k, a):
    quarter = float(time_to_peak(m, k))
    late = quarter * np.array([1.0, 1.5, 40.0, np.inf])
    np.testing.assert_array_equal(attenuation_after_delay(v, m, k, a, late), 0.0)
    np.testing.assert_array_equal(braked_deflection(v, m, k, a, late), peak_deflection(v, m, k))
    falling = attenuation_after_delay(v, m, k, a, quarter * np.linspace(0.0, 0.999, 20))
    assert (np.diff(falling) < 0.0).all() and (falling > 0.0).all() and (falling < 1.0).all()


def test_the_appendix_example_exceeds_700_n():
    # 17.5 J into 15,000 N/m; the force depends on the energy alone.
    for m in (2.0, 40.0):
        assert peak_force(np.sqrt(2.0 * 17.5 / m), m, 15_000.0) == pytest.approx(
            np.sqrt(2.0 * 17.5 * 15_000.0)
        )
        assert peak_force(np.sqrt(2.0 * 17.5 / m), m, 15_000.0) > 700.0


@given(st.floats(0.0, 1e4), masses, stiffnesses)
def test_a_speed_limit_gives_its_force(force, m, k):
    assert peak_force(speed_limit(force, m, k), m, k) == pytest.approx(force, rel=1e-12, abs=1e-12)


def test_what_recedes_counts_as_at_rest():
    v = np.array([-3.0, 0.0])
    for function in (peak_deflection, peak_force):
        np.testing.assert_array_equal(function(v, 2.0, 1e4), 0.0)
    np.testing.assert_array_equal(braked_deflection(v, 2.0, 1e4, 5.0), 0.0)
    np.testing.assert_array_equal(attenuation_after_delay(v, 2.0, 1e4, 5.0, 0.0), 0.0)
    # A push of m a on a spring at rest goes twice as deep as it would rest.
    np.testing.assert_allclose(braked_deflection(v, 2.0, 1e4, -5.0), 2.0 * 2.0 * 5.0 / 1e4)


def test_infinite_stiffness_and_mass():
    assert peak_deflection(1.0, 2.0, np.inf) == 0.0 and braked_deflection(1.0, 2.0, np.inf, 3.0) == 0.0
    assert peak_force(1.0, 2.0, np.inf) == np.inf and speed_limit(100.0, 2.0, np.inf) == 0.0
    assert peak_force(1.0, np.inf, 1e4) == np.inf and peak_force(0.0, np.inf, 1e4) == 0.0
    assert speed_limit(100.0, np.inf, 1e4) == 0.0 and time_to_peak(2.0, np.inf) == 0.0
    assert peak_deflection(np.array([0.0, 1.0]), np.inf, 1e4).tolist() == [0.0, np.inf]


def test_leading_axes_broadcast():
    v, m, k = np.full((4, 1, 1), 0.5), np.full((3, 1), 2.0), np.full(2, 1e4)
    for function in (peak_deflection, peak_force, speed_limit):
        assert function(v, m, k).shape == (4, 3, 2)
    assert time_to_peak(m, k).shape == (3, 2)
    latency = np.array([0.0, 0.001, 9.0]).reshape(3, 1, 1, 1)
    for function in (braked_deflection, braked_peak_force, attenuation_after_delay):
        deep = function(v, m, k, 20.0, latency)
        assert deep.shape == (3, 4, 3, 2) and deep.dtype == np.float64
        assert deep[1, 2, 1, 0] == function(0.5, 2.0, 1e4, 20.0, 0.001)
    assert braked_deflection(v, m, k, 0.0, latency).shape == (3, 4, 3, 2)


def test_springs_in_series():
    assert series_stiffness(3.0) == pytest.approx(3.0)
    assert series_stiffness(2.0, np.inf) == pytest.approx(2.0)
    assert series_stiffness(np.inf, np.inf) == np.inf
    # Under one force the deflections add up.
    k = np.array([40e3, 15e3, 8e3])
    assert (100.0 / k).sum() == pytest.approx(100.0 / series_stiffness(*k))
    assert series_stiffness(np.ones((2, 1)), np.ones(3)).shape == (2, 3)


# The rigid part: effective mass, restitution, impulse -------------------------------------------------------


def test_effective_mass_is_force_over_acceleration():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 4, 4))
    inertia = root @ root.swapaxes(-1, -2) + 0.1 * np.eye(4)
    rows = rng.normal(size=(5, 4))
    masses = effective_mass(inertia, rows)
    assert masses.shape == (5,)
    for m, j, mass in zip(inertia, rows, masses, strict=True):
        assert j @ np.linalg.inv(m) @ (j * 1.0) == pytest.approx(1.0 / mass, rel=1e-9)
    several = effective_mass(inertia[0], rows)
    assert several.shape == (5,) and several[0] == masses[0]


def test_a_direction_that_no_joint_moves_has_infinite_mass():
    assert effective_mass(np.eye(3), [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]).tolist() == [np.inf, 0.25]


def test_effective_mass_of_a_machine_in_mujoco():
    # Pushed along a direction, the tip accelerates along it by force / effective mass (from rest, no gravity).
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option gravity="0 0 0"/><worldbody><body><joint axis="0 0 1"/><geom type="capsule" size=".03"
        fromto="0 0 0 .5 0 0"/><body pos=".5 0 0"><joint axis="0 1 0"/><geom type="capsule" size=".03"
        fromto="0 0 0 .4 0 0"/><body name="tip" pos=".4 0 0"><geom size=".05"/></body></body></body></worldbody>
        </mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[:] = 0.4, -0.7
    mujoco.mj_forward(model, data)
    inertia, jacobian = np.zeros((2, 2)), np.zeros((3, 2))
    for i, unit in enumerate(np.eye(2)):
        mujoco.mj_mulM(model, data, inertia[i], unit)
    mujoco.mj_jacBody(model, data, jacobian, None, model.body("tip").id)
    for direction in np.array([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8]]):
        data.qfrc_applied[:] = jacobian.T @ direction * 7.0
        mujoco.mj_forward(model, data)
        gained = direction @ jacobian @ data.qacc
        assert effective_mass(inertia, direction @ jacobian) == pytest.approx(7.0 / gained, rel=1e-8)


@given(masses, masses)
def test_two_free_bodies_weigh_less_than_the_lighter_one(m1, m2):
    both = reduced_mass(m1, m2)
    assert both == pytest.approx(m1 * m2 / (m1 + m2)) and both < min(m1, m2)
    assert reduced_mass(m1, np.inf) == pytest.approx(m1)


@given(masses, masses, st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(0.0, 1.0))
def test_momentum_and_the_energy_of_two_bodies_balance(m1, m2, v1, v2, e):
    # Body 1 above body 2: they close when v1 < v2.
    relative = v1 - v2
    assume(relative < 0.0)
    mass = reduced_mass(m1, m2)
    impulse = normal_impulse(mass, relative, e)
    after1, after2 = v1 + impulse / m1, v2 - impulse / m2
    assert impulse >= 0.0
    assert after1 - after2 == pytest.approx(restitution_velocity(relative, e), abs=1e-9)
    lost = 0.5 * (m1 * (v1**2 - after1**2) + m2 * (v2**2 - after2**2))
    assert lost == pytest.approx(0.5 * mass * (1.0 - e**2) * relative**2, abs=1e-7)


def test_what_separates_has_no_impact():
    assert restitution_velocity([-2.0, 0.0, 3.0], 0.5).tolist() == [1.0, 0.0, 3.0]
    assert normal_impulse(4.0, [-2.0, 0.0, 3.0], 0.5).tolist() == [12.0, 0.0, 0.0]


def dropped(mass, stiffness, damping, height, step=2e-5):
    """A ball dropped on a plane whose contact is a spring: normal velocities around the contact, impulse, peak force.

    Negative solref asks for a stiffness and a damping per mass; an impedance near 1 leaves them as they are.
    """
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" gravity="0 0 -9.81" integrator="Euler" cone="elliptic"/>
        <worldbody><geom type="plane" size="1 1 .1" friction="0 0 0" condim="1"
        solref="-1 -1" solimp=".9999 .9999 .001"/>
        <body pos="0 0 {0.1 + height}"><freejoint/><geom size=".1" mass="{mass}" condim="1" friction="0 0 0"
        solref="-1 -1" solimp=".9999 .9999 .001"/></body></worldbody></mujoco>"""
    )
    model.geom_solref[:] = -stiffness / mass, -damping / mass
    data = mujoco.MjData(model)
    before, impulse, peak, wrench = None, 0.0, 0.0, np.zeros(6)
    while data.time < 5.0:
        speed = data.qvel[2]
        mujoco.mj_step(model, data)
        touching = data.ncon > 0 and data.contact[0].efc_address >= 0
        if touching:
            before = speed if before is None else before
            mujoco.mj_contactForce(model, data, 0, wrench)
            impulse, peak = impulse + wrench[0] * step, max(peak, wrench[0])
        elif before is not None:
            return before, data.qvel[2], impulse, peak
    raise AssertionError("it did not come off the ground")


@pytest.mark.parametrize("damping", [0.0, 60.0, 200.0])
def test_a_drop_in_mujoco_bounces_as_its_restitution_says(damping):
    mass, stiffness, height = 2.0, 2e5, 0.3
    before, after, impulse, peak = dropped(mass, stiffness, damping, height)
    ratio = damping / (2.0 * np.sqrt(stiffness * mass))
    # The spring and damper let go when their force is zero: e = exp(-zeta phi / sqrt(1 - zeta^2)).
    root = np.sqrt(1.0 - ratio**2)
    phi = np.arctan2(2.0 * ratio * root, 2.0 * ratio**2 - 1.0) if ratio else np.pi
    e = np.exp(-ratio * phi / root)
    assert before == pytest.approx(-np.sqrt(2.0 * 9.81 * height), rel=1e-3)
    assert after == pytest.approx(float(restitution_velocity(before, e)), rel=0.01)
    held = mass * 9.81 * np.pi * np.sqrt(mass / stiffness)  # what the weight adds during the contact, about
    assert impulse == pytest.approx(float(normal_impulse(mass, before, e)) + held, rel=0.01)
    if not damping:
        assert peak == pytest.approx(float(peak_force(-before, mass, stiffness)) + mass * 9.81, rel=5e-3)
        assert peak == pytest.approx(float(braked_peak_force(-before, mass, stiffness, -9.81)), rel=5e-3)


# Refusals ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: peak_force(np.nan, 1.0, 1.0), "speed must be finite"),
        (lambda: peak_force("fast", 1.0, 1.0), "speed is a number"),
        (lambda: peak_force(1.0, 0.0, 1.0), "mass must be positive"),
        (lambda: peak_force(1.0, 1.0, np.nan), "stiffness must be positive"),
        (lambda: peak_force(1.0, 1.0, "stiff"), "stiffness is a number"),
        (lambda: peak_deflection(1.0, np.inf, np.inf), "both infinite"),
        (lambda: speed_limit(-1.0, 1.0, 1.0), "force must be at least 0"),
        (lambda: braked_deflection(*MACHINE, np.inf), "braking must be finite"),
        (lambda: braked_deflection(*MACHINE, 1.0, -0.1), "latency must be 0 s or more"),
        (lambda: braked_deflection(*MACHINE, 1.0, np.nan), "latency must be 0 s or more"),
        (lambda: braked_deflection(*MACHINE, 1.0, 0.0, -1e-3), "deflection must be finite and 0 m or more"),
        (lambda: braked_deflection(*MACHINE, 1.0, 0.0, np.inf), "deflection must be finite"),
        (lambda: braked_deflection(1.0, np.inf, 1.0, 1.0), "mass must be finite for a brake"),
        (lambda: braked_peak_force(1.0, 1.0, np.inf, 1.0), "stiffness must be finite"),
        (lambda: series_stiffness(), "at least one"),
        (lambda: series_stiffness(1.0, -2.0), "stiffness must be positive"),
        (lambda: reduced_mass(1.0, 0.0), "other must be positive"),
        (lambda: restitution_velocity(-1.0, 1.1), "restitution must be between 0 and 1"),
        (lambda: normal_impulse(np.inf, -1.0, 0.5), "mass must be finite"),
        (lambda: effective_mass(np.eye(2), np.ones(3)), "shape"),
        (lambda: effective_mass(np.eye(2), 1.0), "shape"),
        (lambda: effective_mass([[1.0, 0.5], [0.0, 1.0]], [1.0, 0.0]), "symmetric"),
        (lambda: effective_mass(-np.eye(2), [1.0, 0.0]), "positive definite"),
        (lambda: effective_mass(np.eye(2), [np.nan, 0.0]), "jacobian must be finite"),
    ],
)
def test_bad_input_is_refused_in_words(call, said):
    with pytest.raises(ConfigurationError, match=said):
        call()
