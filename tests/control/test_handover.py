"""Blends: curves and peaks by SciPy's splines, the shortest one in exact fractions (streams: ChunkHandover's)."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicHermiteSpline

from safe_wrappers.control.handover import (
    SMOOTHSTEP_PEAKS,
    SeamCheck,
    SeamLimits,
    bridge,
    join,
    knot_torque_step,
    peaks,
    shortest_blend,
    smoothstep,
)

HOLD = 0.1


def test_smoothstep_is_the_quintic_between_rests_and_clamped_outside():
    oracle = BPoly.from_derivatives([0, 1], [[0, 0, 0], [1, 0, 0]])
    s = np.linspace(0, 1, 101)
    np.testing.assert_allclose(smoothstep(s), oracle(s), atol=1e-12)
    np.testing.assert_array_equal(smoothstep([-1.0, 0.0, 1.0, 7.0]), [0, 0, 1, 1])
    for order in (1, 2, 3):
        assert np.abs(oracle(s, order)).max() == pytest.approx(SMOOTHSTEP_PEAKS[order], rel=1e-3)
    assert np.all(np.diff(smoothstep(np.linspace(0, 1, 100_001))) >= 0.0)


@given(st.floats(-200, 200), st.floats(0.01, 100), st.sampled_from([1, 2, 3]))
def test_the_shortest_blend_of_latched_commands_keeps_the_limit_and_no_shorter_one_does(change, limit, order):
    needed = Fraction(SMOOTHSTEP_PEAKS[order]) * abs(Fraction(change)) / Fraction(limit)
    found = Fraction(float(shortest_blend(change, limit, order))) ** order
    assume(change == 0.0 or found > 1e-200)
    assert needed <= found <= needed * (1 + Fraction(1e-10))


# By quintics ------------------------------------------------------------------------------------------------------


def bridged(sent, new, step, **limits):
    """By quintics, in a box of 100."""
    step, box = np.broadcast_to(step, new.shape[1:]), np.full(new.shape[1], 100.0)
    return SeamCheck(SeamLimits(**limits), new.shape[1], HOLD).join(sent, new, step, 0, -box, box)


@pytest.mark.parametrize("by", [lambda sent, new, step: join(sent, sent[:0], new, step), bridged])
def test_a_limit_for_each_component(by):
    """Two joints in different units: each keeps its own."""
    sent, new = np.zeros((3, 2)), np.tile([1.0, 100.0], (30, 1))
    step = HOLD * np.array([2.0, 200.0])
    plan, steps = by(sent, new, step)
    alone = [by(sent[:, k : k + 1], new[:, k : k + 1], step[k])[1] for k in (0, 1)]
    assert steps == max(alone) > 5
    assert (np.abs(np.diff(np.vstack([sent[-1:], plan]), axis=0)) <= step * (1 + 1e-12)).all()
    assert by(sent, new, np.array([step[0], 1e9]))[1] == steps  # the slow one decides


def test_without_a_bridge_that_keeps_the_step_there_is_none():
    sent, new = np.zeros((3, 1)), np.full((8, 1), 50.0)
    assert bridged(sent, new, 1.0) is None and bridged(sent, new, 20.0)[1] < 8
    assert bridged(sent, new, 20.0, velocity=190.0)[1] > bridged(sent, new, 20.0)[1]


@st.composite
def streams(draw):
    """What was sent, what is new, and where to join it; numbers from a generator, so that ties are accidents."""
    rng, m = np.random.default_rng(draw(st.integers(0, 2**32 - 1))), draw(st.integers(1, 3))
    sent, new = (rng.uniform(-1, 1, (draw(st.integers(*sizes)), m)) for sizes in ((1, 5), (2, 9)))
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
    free, box = np.full(new.shape[1], np.inf), np.full(new.shape[1], 100.0)
    plan, steps = SeamCheck(SeamLimits(), new.shape[1], HOLD).join(sent, new, free, n, -box, box)
    assert steps == n
    np.testing.assert_allclose(curve(HOLD * np.arange(n + 2)), [sent[-1], *plan[: n + 1]], atol=1e-10)


def test_torque_steps_at_knots_are_those_of_scipys_spline():
    rng = np.random.default_rng(0)
    knots, roots = rng.normal(size=(6, 2)), rng.normal(size=(4, 2, 2))
    bend = CubicHermiteSpline(HOLD * np.arange(6), knots, np.gradient(knots, HOLD, axis=0)).derivative(2)
    at = HOLD * np.arange(1, 5)
    jumps = bend(at + 1e-12) - bend(at - 1e-12)
    inertia = roots @ roots.swapaxes(1, 2)
    expected = np.einsum("kij,kj->ki", inertia, jumps)
    np.testing.assert_allclose(knot_torque_step(inertia, HOLD, knots), expected, rtol=1e-6, atol=1e-6)
