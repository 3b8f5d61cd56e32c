"""Traction curves: peaks, slopes and published values."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from safe_wrappers.appendix.vehicle.burckhardt import BURCKHARDT, BURCKHARDT_PUBLISHED, Burckhardt, peak
from safe_wrappers.appendix.vehicle.traction_curves import MAGIC_FORMULA, MagicFormula
from safe_wrappers.errors import ConfigurationError

SETS = {"Magic Formula": MAGIC_FORMULA, "Burckhardt": BURCKHARDT}
CASES = [(name, ground) for name, curves in SETS.items() for ground in curves]


@pytest.mark.parametrize(("kind", "ground"), CASES)
def test_rises_to_a_peak_between_a_tenth_and_fifteen_hundredths_and_falls_behind_it(kind, ground):
    curve = SETS[kind][ground]
    top = peak(curve)
    assert 0.10 - 1e-9 <= top.slip <= 0.15 + 1e-9
    before, behind = np.linspace(0.0, top.slip - 1e-4, 200), np.linspace(top.slip + 1e-4, 1.0, 200)
    assert (curve.slope(before) > 0.0).all()
    assert (curve.slope(behind) < 0.0).all()
    assert curve.at(1.0) == pytest.approx(0.65 * top.friction, rel=0.06)


@pytest.mark.parametrize(("kind", "ground"), CASES)
def test_the_peak_against_scipy(kind, ground):
    curve = SETS[kind][ground]
    found = minimize_scalar(lambda s: -curve.at(s), bounds=(0.0, 1.0), method="bounded")
    assert peak(curve).slip == pytest.approx(found.x, abs=1e-5)
    assert peak(curve).friction == pytest.approx(-found.fun, rel=1e-9)


def test_both_shapes_of_a_ground_have_one_peak():
    for ground, curve in MAGIC_FORMULA.items():
        assert peak(curve) == pytest.approx(peak(BURCKHARDT[ground]), rel=1e-6)


@pytest.mark.parametrize(
    ("ground", "slip", "friction"), [("dry", 0.17, 1.17), ("wet", 0.1308, 0.8013), ("snow", 0.06, 0.19)]
)
def test_published_coefficients_have_their_published_peaks(ground, slip, friction):
    """Closed form: s = ln(c1 c2 / c3) / c2."""
    curve = BURCKHARDT_PUBLISHED[ground]
    exact = math.log(curve.c1 * curve.c2 / curve.c3) / curve.c2
    assert peak(curve).slip == pytest.approx(exact, abs=1e-9) == pytest.approx(slip, rel=2e-3)
    assert peak(curve).friction == pytest.approx(friction, rel=2e-3)


def test_a_curve_that_never_falls_is_highest_at_one():
    assert peak(BURCKHARDT_PUBLISHED["ice"]) == (1.0, 0.05)


@given(st.sampled_from(CASES), st.floats(-1.0, 1.0))
def test_slope_against_differences_and_odd(case, slip):
    curve = SETS[case[0]][case[1]]
    step = 1e-6
    if step < abs(slip) < 1.0 - step:
        differences = (curve.at(slip + step) - curve.at(slip - step)) / (2.0 * step)
        assert float(curve.slope(slip)) == pytest.approx(differences, abs=1e-5)
    assert curve.at(-slip) == -curve.at(slip)
    assert float(curve.friction(slip)) == pytest.approx(curve.at(slip), rel=1e-12, abs=1e-15)


def test_slope_with_curvature_against_differences():
    curve = MagicFormula(10.0, 1.9, 1.0, 0.97)
    slips = np.linspace(0.01, 0.9, 50)
    differences = (curve.friction(slips + 1e-6) - curve.friction(slips - 1e-6)) / 2e-6
    np.testing.assert_allclose(curve.slope(slips), differences, atol=1e-7)
    assert curve.at(0.3) == pytest.approx(float(curve.friction(0.3)), rel=1e-12)


@pytest.mark.parametrize("curve", [MAGIC_FORMULA["dry"], BURCKHARDT["dry"]], ids=["magic", "burckhardt"])
def test_slips_beyond_one_count_as_one(curve):
    assert curve.at(1.7) == curve.at(1.0) == float(curve.friction(1.7))
    assert curve.at(-1.7) == -curve.at(1.0)
    assert float(curve.slope(1.7)) == 0.0


@given(st.floats(0.05, 1.5), st.floats(0.02, 0.3), st.floats(1.2, 1.9))
def test_magic_formula_from_its_peak(friction, slip, shape):
    top = peak(MagicFormula.from_peak(friction, slip, shape))
    assert top.friction == pytest.approx(friction, rel=1e-9)
    assert top.slip == pytest.approx(slip, rel=1e-6)


@given(st.floats(0.05, 1.5), st.floats(0.02, 0.3), st.floats(0.3, 0.9))
def test_burckhardt_from_its_peak(friction, slip, share):
    curve = Burckhardt.from_peak(friction, slip, share * friction)
    assert peak(curve).friction == pytest.approx(friction, rel=1e-6)
    assert peak(curve).slip == pytest.approx(slip, rel=1e-4)
    assert curve.at(1.0) == pytest.approx(share * friction, rel=1e-6)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: MagicFormula(10.0, 1.0, 1.0), "shape"),
        (lambda: MagicFormula(10.0, 1.5, 0.0), "peak_friction"),
        (lambda: MagicFormula(0.0, 1.5, 1.0), "stiffness"),
        (lambda: MagicFormula(10.0, 1.5, 1.0, 1.5), "curvature"),
        (lambda: MagicFormula.from_peak(1.0, 1.0), "peak_slip"),
        (lambda: Burckhardt(-1.0, 1.0, 0.0), "c1"),
        (lambda: Burckhardt(1.0, math.nan, 0.0), "c2"),
        (lambda: Burckhardt(1.0, 10.0, -0.1), "c3"),
        (lambda: Burckhardt.from_peak(1.0, 0.1, 1.0), "sliding_friction"),
        (lambda: Burckhardt.from_peak(1.0, 0.6, 0.5), "peak_slip"),
    ],
)
def test_bad_numbers_are_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()
