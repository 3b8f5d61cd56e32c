"""Flexible joints: against integration of the two-mass model, eigenvalues, and closed forms of one joint."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly

from safe_wrappers.appendix.handover.flexible_joint import (
    accelerations,
    boundary_layer_energy,
    damping_ratios,
    manifold,
    ramp_energy,
    resonances,
    smoothstep_energy,
    step_energy,
    torque_slew_limit,
)
from safe_wrappers.errors import ConfigurationError

K = np.array([160.0, 70.0])
J = np.array([0.05, 0.02])
M = np.array([[0.157, 0.0404], [0.0404, 0.0216]])
MACHINE = (K, J, M)
SMOOTHSTEP = BPoly([[0], [0], [0], [1], [1], [1]], [0, 1])  # the quintic in Bernstein form


def machine(seed, n=None, batch=()):
    """A random machine of n joints."""
    rng = np.random.default_rng(seed)
    n = n or int(rng.integers(1, 4))
    root = rng.normal(size=(*batch, n, n))
    inertia = root @ root.swapaxes(-1, -2) + 0.3 * np.eye(n)
    return rng.uniform(20, 300, n), rng.uniform(0.05, 3, n), inertia


def state_matrix(k, j, m, b=0.0, d=0.0):
    """x' = A x + G torque for x = (theta, q, their rates), written from the equations of motion."""
    n = len(k)
    spring = np.kron([[1, -1], [-1, 1]], np.diag(k))
    damper = np.kron([[1, -1], [-1, 1]], np.eye(n) * d) + scipy.linalg.block_diag(
        np.eye(n) * b, np.zeros((n, n))
    )
    mass = scipy.linalg.block_diag(np.diag(j), m)
    a = np.zeros((4 * n, 4 * n))
    a[: 2 * n, 2 * n :] = np.eye(2 * n)
    a[2 * n :, : 2 * n] = -np.linalg.solve(mass, spring)
    a[2 * n :, 2 * n :] = -np.linalg.solve(mass, damper)
    drive = np.zeros((4 * n, n))
    drive[2 * n : 3 * n] = np.diag(1 / j)
    return a, drive


def ringing(x, torque, k, j, m):
    """Energy that would ring on under a held torque."""
    n = len(k)
    z0 = manifold(torque, j, m)
    return boundary_layer_energy(
        x[..., :n] - x[..., n : 2 * n], x[..., 2 * n : 3 * n] - x[..., 3 * n :], z0, k, j, m
    )


def simulate(torque, times, k, j, m):
    """States at times under a torque that is a function of time, from rest."""
    a, drive = state_matrix(k, j, m)
    done = solve_ivp(
        lambda t, x: a @ x + drive @ torque(t),
        (0.0, times[-1]),
        np.zeros(len(a)),
        "DOP853",
        t_eval=times,
        rtol=1e-10,
        atol=1e-13,
        max_step=0.01,
    )
    return done.y.T


# The model -----------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_accelerations_are_those_of_the_whole_system(seed):
    k, j, m = machine(seed)
    n = len(k)
    rng = np.random.default_rng(seed)
    x, torque = rng.normal(size=4 * n), rng.normal(size=n)
    b, d = rng.uniform(0, 1, n), rng.uniform(0, 1, n)
    a, drive = state_matrix(k, j, m, b, d)
    theta, q, theta_dot, q_dot = x.reshape(4, n)
    motors, links = accelerations(
        theta, q, theta_dot, q_dot, torque, k, j, m, motor_damping=b, joint_damping=d
    )
    np.testing.assert_allclose(np.r_[motors, links], (a @ x + drive @ torque)[2 * n :], rtol=1e-9, atol=1e-9)
    bias = rng.normal(size=n)
    shifted = accelerations(
        theta, q, theta_dot, q_dot, torque, k, j, m, bias=bias, motor_damping=b, joint_damping=d
    )
    np.testing.assert_allclose(shifted[0], motors)
    np.testing.assert_allclose(m @ (links - shifted[1]), bias, rtol=1e-9, atol=1e-9)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_on_the_manifold_motor_and_link_move_as_one_rigid_arm(seed):
    k, j, m = machine(seed)
    rng = np.random.default_rng(seed)
    torque, bias, speed, q = rng.normal(size=(4, len(k)))
    b = rng.uniform(0, 1, len(k))
    z0 = manifold(torque, j, m, bias=bias, motor_friction=b * speed)
    motors, links = accelerations(q + z0 / k, q, speed, speed, torque, k, j, m, bias=bias, motor_damping=b)
    np.testing.assert_allclose(motors, links, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose((m + np.diag(j)) @ links + bias + b * speed, torque, rtol=1e-8, atol=1e-8)
    # The appendix's own form, which it gives without friction.
    w = np.diag(1 / j) + np.linalg.inv(m)
    stated = np.linalg.solve(w, torque / j + np.linalg.solve(m, bias))
    np.testing.assert_allclose(manifold(torque, j, m, bias=bias), stated, rtol=1e-8, atol=1e-10)


# Resonances ----------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_resonances_are_the_free_frequencies_of_both_masses(seed):
    k, j, m = machine(seed)
    n = len(k)
    spring = np.kron([[1, -1], [-1, 1]], np.diag(k))
    squares = scipy.linalg.eigh(spring, scipy.linalg.block_diag(np.diag(j), m), eigvals_only=True)
    assert np.abs(squares[:n]).max() < 1e-6 * squares[n]  # both masses together: the rigid motion
    omega = resonances(k, j, m)
    np.testing.assert_allclose(omega, np.sqrt(squares[n:]), rtol=1e-7)


def test_damping_ratios_are_those_of_the_whole_system():
    b, d = np.array([0.12, 0.03]), np.array([0.012, 0.006])
    poles = np.linalg.eigvals(state_matrix(*MACHINE, b, d)[0])
    ringing_poles = sorted((p for p in poles if p.imag > 1.0), key=abs)
    ratios = damping_ratios(*MACHINE, b, d)
    np.testing.assert_allclose(ratios, [-p.real / abs(p) for p in ringing_poles], rtol=0.01)
    # Light damping is what it is for: a tenth of it is ten times as near.
    poles = np.linalg.eigvals(state_matrix(*MACHINE, b / 10, d / 10)[0])
    ringing_poles = sorted((p for p in poles if p.imag > 1.0), key=abs)
    np.testing.assert_allclose(ratios / 10, [-p.real / abs(p) for p in ringing_poles], rtol=1e-3)


# Energy --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_energy_is_kept_in_the_undamped_boundary_layer(seed):
    k, j, m = machine(seed)
    n = len(k)
    a, drive = state_matrix(k, j, m)
    rng = np.random.default_rng(seed)
    torque = rng.normal(size=n)
    done = solve_ivp(
        lambda t, x: a @ x + drive @ torque, (0, 3), rng.normal(size=4 * n), "DOP853", rtol=1e-11, atol=1e-12
    )
    energy = ringing(done.y.T, torque, k, j, m)
    assert energy[0] > 0.1
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)


def test_energy_of_a_step_is_what_rings_after_it():
    torque = np.array([1.0, -0.4])
    times = np.linspace(0.0, 0.4, 401)
    x = simulate(lambda t: torque, times, *MACHINE)
    np.testing.assert_allclose(ringing(x, torque, *MACHINE), step_energy(torque, *MACHINE), rtol=1e-7)
    # One joint: the link comes along with M / (J + M) of the torque, and the spring swings to twice that.
    one = np.array([30.0]), np.array([0.2]), np.array([[0.6]])
    assert step_energy([2.0], *one) == pytest.approx(0.5 * 1.5**2 / 30.0)
    x = simulate(lambda t: np.array([2.0]), np.linspace(0, 1, 2001), *one)
    assert (x[:, 0] - x[:, 1]).max() == pytest.approx(2 * 1.5 / 30.0, rel=1e-5)


def test_a_ramp_leaves_at_most_its_bound_and_reaches_it_with_one_joint():
    one = np.array([30.0]), np.array([0.2]), np.array([[0.6]])
    omega = float(resonances(*one)[0])
    shares = []
    for periods in (0.3, 0.5, 1.0, 1.5, 2.2):
        duration = 2 * np.pi / omega * periods
        times = np.linspace(0.0, duration, 60)
        x = simulate(lambda t, d=duration: np.array([2.0 * t / d]), times, *one)
        bound = ramp_energy([2.0], duration, *one)
        left = [float(ringing(s, [2.0 * t / duration], *one)) for s, t in zip(x, times, strict=True)]
        assert max(left) <= bound * (1 + 1e-6)  # wherever it stops
        shares.append(left[-1] / bound)
    assert shares[1] == pytest.approx(1.0)  # half a period, and one and a half: the kicks add up
    assert shares[3] == pytest.approx(1.0)
    assert shares[2] == pytest.approx(0.0, abs=1e-6)  # a whole period: they cancel


def test_about_the_moving_manifold_a_ramp_has_the_energy_of_its_kick():
    torque, duration = np.array([1.0, -0.4]), 0.13
    times = np.linspace(0.0, duration, 40)
    x = simulate(lambda t: torque * t / duration, times, *MACHINE)
    rate = manifold(torque / duration, J, M)
    z0 = manifold(np.outer(times / duration, torque), J, M)
    energy = boundary_layer_energy(x[:, :2] - x[:, 2:4], x[:, 4:6] - x[:, 6:], z0, *MACHINE, rate)
    w = np.diag(1 / J) + np.linalg.inv(M)
    r = rate / K
    np.testing.assert_allclose(energy, 0.5 * r @ np.linalg.solve(w, r), rtol=1e-6)


@pytest.mark.parametrize("periods", [0.2, 1.0, 1.7, 2.0, 3.1, 4.5])
def test_a_smoothstep_leaves_at_most_its_bounds(periods):
    torque = np.array([1.0, -0.4])
    duration = periods * 2 * np.pi / float(resonances(*MACHINE)[0])
    times = np.linspace(0.0, duration, 200)
    x = simulate(lambda t: torque * float(SMOOTHSTEP(t / duration)), times, *MACHINE)
    left = ringing(x, np.outer(SMOOTHSTEP(times / duration), torque), *MACHINE)
    assert left[-1] <= smoothstep_energy(torque, duration, *MACHINE) * (1 + 1e-6)
    assert left.max() <= smoothstep_energy(torque, duration, *MACHINE, cut_short=True) * (1 + 1e-6)
    if periods >= 2.0:  # what a blend is for
        assert left[-1] < step_energy(torque, *MACHINE) / 100
        assert left.max() < step_energy(torque, *MACHINE) / 10


def test_the_smoothstep_bound_is_reached_with_one_joint():
    one = np.array([30.0]), np.array([0.2]), np.array([[0.6]])
    omega = float(resonances(*one)[0])
    x = np.linspace(0.0, 1.0, 4001)
    durations = np.linspace(0.4, 1.4, 300)
    slope = SMOOTHSTEP.derivative()(x)
    exact = [np.abs(np.trapezoid(slope * np.exp(-1j * omega * t * x), x)) ** 2 for t in durations]
    share = np.array(exact) * step_energy([1.0], *one)
    bound = np.array([smoothstep_energy([1.0], t, *one) for t in durations])
    assert (share <= bound * (1 + 1e-6)).all()
    assert (share / bound).max() > 0.999


# The slew limit ------------------------------------------------------------------------------------------


def ramps_energy(rates, durations, hold, k, j, m):
    """Energy left by ramps of every duration (or staircases of the same slope), by the exact transition matrix."""
    a, drive = state_matrix(k, j, m)
    n = len(k)
    step = hold or 1e-3
    size = len(a)
    whole = np.zeros((size + 2 * n, size + 2 * n))  # the torque and its rate are states, too
    whole[:size, :size], whole[:size, size : size + n] = a, drive
    if not hold:
        whole[size : size + n, size + n :] = np.eye(n)
    advance = scipy.linalg.expm(whole * step)
    x = np.concatenate([np.zeros(size + n), rates])
    left = []
    for _ in range(round(durations / step)):
        if hold:
            x[size : size + n] += rates * hold
        x = advance @ x
        left.append(ringing(x[:size], x[size : size + n], k, j, m))
    return np.array(left)


@pytest.mark.slow
@pytest.mark.parametrize("hold", [0.0, 0.01])
@pytest.mark.parametrize("weights", [1.0, [3.0, 1.0]])
def test_ramps_at_the_limit_stay_below_the_energy_and_come_near_it(hold, weights):
    allowed = 1e-3
    limit = torque_slew_limit(allowed, *MACHINE, weights=weights, control_dt=hold)
    np.testing.assert_allclose(limit / limit[1], np.broadcast_to(weights, 2) / np.broadcast_to(weights, 2)[1])
    worst = max(
        ramps_energy(limit * signs, 3.0, hold, *MACHINE).max()
        for signs in itertools.product((1.0, -1.0), repeat=2)
    )
    assert 0.97 * allowed < worst <= allowed * (1 + 1e-9)


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_no_ramp_within_the_limit_exceeds_the_energy(seed):
    k, j, m = machine(seed)
    limit = torque_slew_limit(0.02, k, j, m)
    rates = limit * np.random.default_rng(seed).uniform(-1, 1, len(k))
    assert ramps_energy(rates, 0.5, 0.0, k, j, m).max() <= 0.02


def test_a_rate_limit_alone_bounds_nothing():
    """Why the limit is for one ramp: a torque that turns round twice per period, within the same rate, pumps."""
    one = np.array([30.0]), np.array([0.2]), np.array([[0.6]])
    limit = float(torque_slew_limit(1e-3, *one)[0])
    period = 2 * np.pi / float(resonances(*one)[0])

    def triangle(t):
        return np.array([limit * period / 4 * scipy.signal.sawtooth(2 * np.pi * t / period, 0.5)])

    times = np.linspace(0, 8 * period, 801)
    x = simulate(triangle, times, *one)
    assert max(float(ringing(s, triangle(t), *one)) for s, t in zip(x, times, strict=True)) > 0.02


# Batches and refusals ------------------------------------------------------------------------------------


def test_batches_are_element_by_element():
    k, j, m = machine(3, n=2, batch=(4, 3))
    rng = np.random.default_rng(0)
    x, torque = rng.normal(size=(4, 4, 3, 2)), rng.normal(size=(4, 3, 2))
    together = {
        "accelerations": accelerations(*x, torque, k, j, m, bias=torque, motor_damping=0.1)[1],
        "manifold": manifold(torque, j, m, bias=x[0], motor_friction=x[1]),
        "resonances": resonances(k, j, m),
        "damping": damping_ratios(k, j, m, 0.1, 0.01),
        "energy": boundary_layer_energy(x[0], x[1], torque, k, j, m, x[2]),
        "step": step_energy(torque, k, j, m),
        "ramp": ramp_energy(torque, 0.1, k, j, m),
        "smoothstep": smoothstep_energy(torque, 0.1, k, j, m),
        "limit": torque_slew_limit(0.1, k, j, m),
    }
    for i in np.ndindex(4, 3):
        y, t, mi = x[:, *i], torque[i], m[i]
        alone = {
            "accelerations": accelerations(*y, t, k, j, mi, bias=t, motor_damping=0.1)[1],
            "manifold": manifold(t, j, mi, bias=y[0], motor_friction=y[1]),
            "resonances": resonances(k, j, mi),
            "damping": damping_ratios(k, j, mi, 0.1, 0.01),
            "energy": boundary_layer_energy(y[0], y[1], t, k, j, mi, y[2]),
            "step": step_energy(t, k, j, mi),
            "ramp": ramp_energy(t, 0.1, k, j, mi),
            "smoothstep": smoothstep_energy(t, 0.1, k, j, mi),
            "limit": torque_slew_limit(0.1, k, j, mi),
        }
        for name, value in alone.items():
            np.testing.assert_allclose(together[name][i], value, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: resonances([160.0, 0.0], J, M), "stiffness must be 2 positive numbers"),
        (lambda: resonances([160.0, 70.0, 3.0], J, M), "stiffness must be 2 positive numbers"),
        (lambda: resonances(K, [np.nan, 0.02], M), "rotor_inertia must be 2 positive numbers"),
        (lambda: resonances(K, J, M[0]), r"link_inertia must have shape \(\.\.\., n, n\), got \(2,\)"),
        (lambda: resonances(K, J, -M), "symmetric and positive definite"),
        (lambda: resonances(K, J, [[1.0, 0.5], [0.4, 1.0]]), "symmetric and positive definite"),
        (lambda: resonances(K, J, [[np.inf, 0.0], [0.0, 1.0]]), "symmetric and positive definite"),
        (lambda: ramp_energy([1.0, 0.0], 0.0, *MACHINE), "duration must be positive"),
        (lambda: smoothstep_energy([1.0, 0.0], np.nan, *MACHINE), "duration must be positive"),
        (lambda: torque_slew_limit(0.0, *MACHINE), "energy must be positive"),
        (lambda: torque_slew_limit(1.0, *MACHINE, weights=[1.0, -1.0]), "weights must be positive"),
        (lambda: torque_slew_limit(1.0, *MACHINE, control_dt=0.04), r"half a period .*16\.5 Hz.* got 0\.04"),
        (lambda: torque_slew_limit(1.0, *MACHINE, control_dt=-0.01), "control_dt must be 0 or more"),
        (lambda: torque_slew_limit(1.0, *MACHINE, control_dt=np.nan), "control_dt must be 0 or more"),
    ],
)
def test_bad_input_is_refused(call, said):
    with pytest.raises(ConfigurationError, match=said):
        call()
