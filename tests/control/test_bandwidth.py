"""Bandwidth: hold lag and margins by python-control, modes by SciPy's eigenvalues."""

import control as ct
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.bandwidth import ControlLoop, modes


def phase_lag(crossover, hold, delay=0.0):
    """What they take, rad."""
    return np.radians(90.0 - ControlLoop(crossover, 90.0).margin_left_deg(hold, delay))


@given(st.floats(0.01, 100), st.floats(0.01, 0.49))
def test_a_hold_lags_by_half_its_interval(crossover, share_of_the_sampling_rate):
    hold = share_of_the_sampling_rate * 2 * np.pi / crossover
    hold_response = (1 - np.exp(-1j * crossover * hold)) / (1j * crossover * hold)
    assert phase_lag(crossover, hold) == pytest.approx(-np.angle(hold_response), rel=1e-9)
    # The printed number.
    assert np.degrees(phase_lag(crossover, hold)) == pytest.approx(28.65 * crossover * hold, rel=1e-4)


S = ct.tf("s")
LOOPS = {
    "speed of a cart": 4 / S,
    "position of a cart, PD": (4 + 5 * S) / S**2,
    "servo with a motor's lag": 30 / (S * (S + 8)),
    "three lags": 12 / ((S + 1) * (S + 2) * (S + 3)),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning:control", "ignore:stability_margins:UserWarning")
@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("late_by", [0, 1, 3])
def test_the_margin_that_is_left_is_the_sampled_loop_s(name, late_by):
    loop = LOOPS[name]
    _, margin, _, crossover = ct.margin(loop)
    hold = 0.02 * 2 * np.pi / crossover  # crossover at a fiftieth of the sampling rate
    z = ct.tf([1, 0], [1], hold)
    sampled = ct.sample_system(loop, hold, "zoh") * z**-late_by
    # margin() reports the worst phase margin of a sampled loop: these cross over once below Nyquist
    _, found, _, at = ct.margin(sampled)
    predicted = np.radians(margin) - phase_lag(crossover, hold, late_by * hold)
    assert at == pytest.approx(crossover, rel=0.01)
    assert np.radians(found) == pytest.approx(predicted, abs=0.012)
    assert np.radians(margin) - predicted > 0.06 * (1 + 2 * late_by)  # what the two agree on is not small


@given(st.integers(0, 2**32 - 1))
def test_modes_are_scipys_and_light_damping_moves_its_eigenvalues_as_they_say(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    roots = rng.normal(size=(3, n, n))
    inertia = roots[0] @ roots[0].T + 0.3 * np.eye(n)
    stiffness = roots[1] @ np.diag(np.r_[0.0, rng.uniform(50, 900, n - 1)]) @ roots[1].T  # one rigid motion
    damping = 1e-4 * roots[2] @ roots[2].T
    found = modes(inertia, stiffness, damping)
    squares = np.sort(scipy.linalg.eigh(stiffness, inertia, eigvals_only=True))
    np.testing.assert_allclose(found.resonances**2, squares, rtol=1e-6, atol=1e-6 * squares[-1])
    assert found.resonances[0] == found.damping_ratios[0] == 0.0
    np.testing.assert_allclose(found.shapes.T @ inertia @ found.shapes, np.eye(n), atol=1e-7)
    system = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(inertia, np.hstack([stiffness, damping]))]]
    )
    values = np.linalg.eigvals(system)
    ringing = values[values.imag > 1e-3]
    ringing = ringing[np.argsort(np.abs(ringing))]
    np.testing.assert_allclose(found.resonances[1:], np.abs(ringing), rtol=1e-4)
    np.testing.assert_allclose(
        found.damping_ratios[1:], -ringing.real / np.abs(ringing), rtol=1e-2, atol=1e-9
    )
