"""Curves of blends against scipy's splines, and their peaks against dense sampling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicHermiteSpline

from safe_wrappers.control.handover.curves import BlendCurve, knot_torque_step
from safe_wrappers.control.handover.seams import BLENDS, join

HOLD = 0.1


def smooth(s):
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


@st.composite
def streams(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m = draw(st.integers(1, 3))
    sent = rng.uniform(-1, 1, (draw(st.integers(1, 4)), m))
    prior = rng.uniform(-1, 1, (draw(st.integers(0, 9)), m))
    new = rng.uniform(-1, 1, (draw(st.integers(2, 9)), m))
    return sent, prior, new, draw(st.integers(0, len(new) - 1))


def slopes(new):
    return np.gradient(new, HOLD, axis=0)


def curve_by_scipy(blend, sent, prior, new, n):
    """A function of time over (n + 1) control steps, from the definitions."""
    rate = (sent[-1] - sent[-2]) / HOLD if len(sent) > 1 else np.zeros_like(sent[-1])
    bend = np.diff(sent[-3:], n=2, axis=0)[0] / HOLD**2 if len(sent) > 2 else np.zeros_like(rate)
    end_bend = np.diff(new, n=2, axis=0)[n - 1] / HOLD**2 if 0 < n < len(new) - 1 else np.zeros_like(rate)
    ends = [[sent[-1], rate, bend], [new[n], slopes(new)[n], end_bend]]
    if blend != "smoothstep" or n == 0:
        kept = 3 if blend == "quintic" else 2
        return BPoly.from_derivatives([0.0, (n + 1) * HOLD], [e[:kept] for e in ends])
    times = HOLD * np.arange(n + 2)
    fresh = np.concatenate([new[:1] - HOLD * slopes(new)[:1], new[: n + 1]])
    fresh = CubicHermiteSpline(times, fresh, np.concatenate([slopes(new)[:1], slopes(new)[: n + 1]]))
    if n > len(prior):
        return lambda t: sent[-1] + smooth(t / times[-1])[..., None] * (fresh(t) - sent[-1])
    old = np.concatenate([sent[-1:], prior[: n + 1]])
    if len(old) < n + 2:
        old = np.concatenate([old, [2 * old[-1] - old[-2]]])
    rates = np.gradient(old, HOLD, axis=0)
    rates[0] = rate
    old = CubicHermiteSpline(times, old, rates)
    return lambda t: old(t) + smooth(t / times[-1])[..., None] * (fresh(t) - old(t))


@pytest.mark.parametrize("blend", BLENDS)
@given(scenario=streams())
def test_a_curve_is_scipys_and_its_peaks_are_those_of_dense_samples(blend, scenario):
    sent, prior, new, n = scenario
    curve, oracle = BlendCurve.of(blend, sent, prior, new, n, HOLD), curve_by_scipy(blend, *scenario)
    fine, span = 4000, (n + 1) * HOLD
    dense = oracle(np.linspace(0.0, span, fine * (n + 1) + 1))
    t = np.linspace(0.0, span, 7 * (n + 1))
    np.testing.assert_allclose(curve.curve(t), oracle(t), atol=1e-10)
    np.testing.assert_allclose(curve.peak(0), np.abs(dense).max(axis=0), rtol=1e-5)
    rate = np.abs(np.diff(dense, axis=0)).max(axis=0) * fine / HOLD
    np.testing.assert_allclose(curve.peak(1), rate, rtol=2e-3, atol=2e-3)
    # The higher derivatives inside of the pieces; jumps between them have their own test.
    for order in (2, 3):
        inner = np.abs(curve.curve.derivative(order)(np.linspace(0.0, span, 2001 * (n + 1)))).max(axis=0)
        assert (curve.peak(order) >= inner * (1 - 1e-9)).all()


@pytest.mark.parametrize("blend", BLENDS)
@given(scenario=streams())
def test_at_the_control_steps_it_is_what_is_sent(blend, scenario):
    sent, prior, new, n = scenario
    joined = join(sent, prior, new, HOLD, blend=blend, accepts=lambda steps: steps == n)
    assert joined.steps == n
    motion = BlendCurve.of(blend, sent, prior, new, n, HOLD).motion()
    at = [np.flatnonzero(np.isclose(motion.times, HOLD * (i + 1)))[-1] for i in range(n + 1)]
    np.testing.assert_allclose(motion.position[at], joined.plan[: n + 1], atol=1e-10)
    np.testing.assert_allclose(motion.position[0], sent[-1])
    assert (np.diff(motion.times) >= -1e-12).all()


def test_a_rate_that_breaks_off_counts_as_an_acceleration_within_a_control_step():
    sent, new = np.array([[0.0], [0.3]]), np.full((8, 1), 1.0)
    latched = BlendCurve.of("smoothstep", sent, np.zeros((0, 1)), new, 7, HOLD)
    assert latched.peak(2) == pytest.approx(0.3 / HOLD**2)  # far above 5.77 * 0.7 / 0.8^2 of the blend itself
    assert latched.peak(3) == pytest.approx(0.3 / HOLD**3)
    bridge = BlendCurve.of("quintic", sent, np.zeros((0, 1)), new, 7, HOLD)
    assert bridge.peak(2) < 15.0


@pytest.mark.parametrize(("order", "peak"), [(1, 1.875), (2, 10 / np.sqrt(3)), (3, 60.0)])
def test_between_held_commands_the_peaks_are_the_closed_forms(order, peak):
    held = np.zeros((3, 1)), np.zeros((9, 1)), np.full((9, 1), 2.0)
    for blend in ("smoothstep", "quintic"):
        found = BlendCurve.of(blend, *held, 4, HOLD).peak(order)
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
