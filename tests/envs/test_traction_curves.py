"""Traction curves of the grounds: each rises to the peak that it is made with, and falls behind it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from safe_wrappers.envs.ground import MAGIC_FORMULA, MagicFormula


@given(st.floats(0.05, 1.5), st.floats(0.02, 0.3), st.floats(1.2, 1.9))
def test_the_peak_against_scipy(friction, slip, shape):
    curve = MagicFormula(friction, slip, shape)
    found = minimize_scalar(lambda s: -curve.at(s), bounds=(0.0, 1.0), method="bounded")
    assert found.x == pytest.approx(slip, abs=1e-4)
    assert -found.fun == pytest.approx(friction, rel=1e-6)


@pytest.mark.parametrize("ground", MAGIC_FORMULA)
def test_the_slope_is_negative_behind_a_peak_between_a_tenth_and_fifteen_hundredths(ground):
    curve = MAGIC_FORMULA[ground]
    assert 0.10 <= curve.peak_slip <= 0.15
    assert (np.diff(curve.friction(np.linspace(0.0, curve.peak_slip, 200))) > 0.0).all()
    assert (np.diff(curve.friction(np.linspace(curve.peak_slip, 1.0, 200))) < 0.0).all()
    assert curve.at(1.0) == pytest.approx(0.65 * curve.peak_friction, rel=0.06)


@given(st.sampled_from(list(MAGIC_FORMULA)), st.floats(-2.0, 2.0))
def test_odd_the_same_for_arrays_and_constant_beyond_one(ground, slip):
    curve = MAGIC_FORMULA[ground]
    assert curve.at(-slip) == -curve.at(slip)
    assert curve.at(slip) == curve.at(min(max(slip, -1.0), 1.0))
    assert float(curve.friction(slip)) == pytest.approx(curve.at(slip), rel=1e-12, abs=1e-15)
