"""Curves of blends against scipy's splines, and their peaks against dense sampling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicHermiteSpline

from safe_wrappers.control.handover import SeamCheck, SeamLimits, bridge, knot_torque_step, peaks

HOLD = 0.1


@st.composite
def streams(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m = draw(st.integers(1, 3))
    sent = rng.uniform(-1, 1, (draw(st.integers(1, 4)), m))
    new = rng.uniform(-1, 1, (draw(st.integers(2, 9)), m))
    return sent, new, draw(st.integers(0, len(new) - 1))


def curve_by_scipy(sent, new, n):
    """A function of time over (n + 1) control steps, from the definitions."""
    rate = (sent[-1] - sent[-2]) / HOLD if len(sent) > 1 else np.zeros_like(sent[-1])
    bend = np.diff(sent[-3:], n=2, axis=0)[0] / HOLD**2 if len(sent) > 2 else np.zeros_like(rate)
    end_bend = np.diff(new, n=2, axis=0)[n - 1] / HOLD**2 if 0 < n < len(new) - 1 else np.zeros_like(rate)
    end_rate = np.gradient(new, HOLD, axis=0)[n]
    return BPoly.from_derivatives(
        [0.0, (n + 1) * HOLD], [[sent[-1], rate, bend], [new[n], end_rate, end_bend]]
    )


@given(scenario=streams())
def test_a_curve_is_scipys_and_its_peaks_are_those_of_dense_samples(scenario):
    sent, new, n = scenario
    curve, oracle = bridge(sent, new, n, HOLD), curve_by_scipy(*scenario)
    fine, span = 4000, (n + 1) * HOLD
    dense = oracle(np.linspace(0.0, span, fine * (n + 1) + 1))
    t = np.linspace(0.0, span, 7 * (n + 1))
    np.testing.assert_allclose(curve(t), oracle(t), atol=1e-10)
    np.testing.assert_allclose(peaks(curve, 0), np.abs(dense).max(axis=0), rtol=1e-5)
    rate = np.abs(np.diff(dense, axis=0)).max(axis=0) * fine / HOLD
    np.testing.assert_allclose(peaks(curve, 1), rate, rtol=2e-3, atol=2e-3)
    for order in (2, 3):
        inner = np.abs(curve.derivative(order)(np.linspace(0.0, span, 2001 * (n + 1)))).max(axis=0)
        assert (peaks(curve, order) >= inner * (1 - 1e-9)).all()


@given(scenario=streams())
def test_at_the_control_steps_it_is_what_is_sent(scenario):
    sent, new, n = scenario
    free, box = np.full(new.shape[1], np.inf), np.full(new.shape[1], 100.0)
    plan, steps = SeamCheck(SeamLimits(), new.shape[1], HOLD).join(sent, new, free, n, -box, box)
    assert steps == n
    curve = bridge(sent, new, n, HOLD)
    np.testing.assert_allclose(curve(HOLD * np.arange(1, n + 2)), plan[: n + 1], atol=1e-10)
    np.testing.assert_allclose(curve(0.0), sent[-1])


@pytest.mark.parametrize(("order", "peak"), [(1, 1.875), (2, 10 / np.sqrt(3)), (3, 60.0)])
def test_between_held_commands_the_peaks_are_the_closed_forms(order, peak):
    found = peaks(bridge(np.zeros((3, 1)), np.full((9, 1), 2.0), 4, HOLD), order)
    assert found == pytest.approx(2.0 * peak / 0.5**order)


def test_torque_steps_at_knots_are_those_of_scipys_spline():
    rng = np.random.default_rng(0)
    knots, roots = rng.normal(size=(6, 2)), rng.normal(size=(4, 2, 2))
    bend = CubicHermiteSpline(HOLD * np.arange(6), knots, np.gradient(knots, HOLD, axis=0)).derivative(2)
    at = HOLD * np.arange(1, 5)
    jumps = bend(at + 1e-12) - bend(at - 1e-12)
    inertia = roots @ roots.swapaxes(1, 2)
    expected = np.einsum("kij,kj->ki", inertia, jumps)
    np.testing.assert_allclose(knot_torque_step(inertia, HOLD, knots), expected, rtol=1e-6, atol=1e-6)
