"""The smoothstep, and the shortest blend of latched commands in exact rational arithmetic."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from safe_wrappers.control.handover import SMOOTHSTEP_PEAKS, shortest_blend, smoothstep

COMMAND = st.floats(-100, 100).map(lambda x: round(x, 9))  # steps that rational arithmetic can take in a test
LIMIT = st.floats(0.01, 100)


def test_smoothstep_is_the_quintic_between_rests_and_clamped_outside():
    oracle = BPoly.from_derivatives([0, 1], [[0, 0, 0], [1, 0, 0]])
    s = np.linspace(0, 1, 101)
    np.testing.assert_allclose(smoothstep(s), oracle(s), atol=1e-12)
    np.testing.assert_array_equal(smoothstep([-1.0, 0.0, 1.0, 7.0]), [0, 0, 1, 1])
    assert oracle(0.5, 1) == pytest.approx(SMOOTHSTEP_PEAKS[1])
    assert np.all(np.diff(smoothstep(np.linspace(0, 1, 100_001))) >= 0.0)


def exact_rate(prior, prior_rate, new, new_rate, s, tau):
    """The appendix's formula in rational arithmetic: no rounding."""
    p, rp, n, rn, s, tau = (Fraction(float(x)) for x in (prior, prior_rate, new, new_rate, s, tau))
    alpha = s**3 * (10 - 15 * s + 6 * s**2)
    step = n + rn * s * tau - p - rp * s * tau
    return 30 * s**2 * (1 - s) ** 2 * step / tau + (1 - alpha) * rp + alpha * rn


@given(COMMAND, COMMAND, LIMIT)
def test_latched_commands_give_the_latched_formula(prior, new, limit):
    latched = shortest_blend(new - prior, limit)
    assert shortest_blend(0.0, limit) == 0.0
    assert latched == pytest.approx(1.875 * abs(new - prior) / limit, rel=1e-11)
    if latched > 0:
        assert abs(exact_rate(prior, 0, new, 0, 0.5, latched)) <= Fraction(limit)
        assert abs(exact_rate(prior, 0, new, 0, 0.5, latched * (1 - 1e-11))) > Fraction(limit)


def test_the_latched_formula_is_too_short_for_a_moving_endpoint():
    limit = 2.0
    latched = shortest_blend(1.0, limit)
    assert exact_rate(0.0, 0.5, 1.0, 0.5, 0.5, latched) > limit
