"""The estimate of a traction curve's peak: from slips that a limiter lets a wheel have."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.vehicle import PEAK_SLIPS, FrictionEstimate
from safe_wrappers.envs.ground import MagicFormula


def learn(estimate, curve, slips, noise=0.02, seed=0, travel=0.01):
    rng = np.random.default_rng(seed)
    n = estimate.mean.size
    for slip in slips:
        measured = curve.friction(np.full(n, slip)) + noise * rng.normal(size=n)
        estimate.travel(np.full(n, travel))
        estimate.update(np.full(n, slip), measured, np.full(n, noise))


class Burckhardt(NamedTuple):
    """Burckhardt's curve, for slips of at least 0: friction `c1 (1 - exp(-c2 s)) - c3 s`."""

    c1: float
    c2: float
    c3: float

    def friction(self, slip):
        return -self.c1 * np.expm1(-self.c2 * slip) - self.c3 * slip


@pytest.mark.parametrize(
    ("curve", "peak"),
    [
        (Burckhardt(1.070509, 31.485949, 0.410509), 1.0),
        (Burckhardt(0.742827, 38.090353, 0.292827), 0.7),
        (Burckhardt(0.322646, 28.866173, 0.122646), 0.3),
    ],
)
def test_a_curve_of_another_shape(curve, peak):
    """What it says of it is off by more than its standard deviation, but of use."""
    estimate = FrictionEstimate(4)
    learn(estimate, curve, np.linspace(0.02, 0.2, 120))
    np.testing.assert_allclose(estimate.mean, peak, rtol=0.2)
    # Friction is lost by standing beside the peak: at the slip that is found, less than a twentieth.
    assert (curve.friction(estimate.peak_slip[0]) > 0.95 * peak).all()


def test_the_height_is_the_truth_but_for_a_few_hundredths():
    """Over random curves of its shape and random slips up to their peaks."""
    rng, off = np.random.default_rng(1), []
    for seed in range(200):
        slip = rng.uniform(0.06, 0.2)
        curve = MagicFormula(rng.uniform(0.1, 1.1), slip)
        estimate = FrictionEstimate(1)
        learn(estimate, curve, rng.uniform(0.0, 1.2 * slip, 40), seed=seed)
        off.append(abs(estimate.mean[0] - curve.peak_friction))
    assert np.quantile(off, 0.9) < 0.03


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 1e3), st.floats(1e-3, 10.0)), max_size=40))
def test_always_finite(measurements):
    estimate = FrictionEstimate(1)
    for slip, friction, noise in measurements:
        estimate.travel(np.array([slip]))
        estimate.update(np.array([slip]), np.array([friction]), np.array([noise]))
    assert np.isfinite(estimate.mean).all()
    assert estimate.weights.sum() == pytest.approx(1.0)
    assert PEAK_SLIPS[0] - 1e-9 <= estimate.peak_slip[0][0] <= PEAK_SLIPS[-1] + 1e-9


# FrictionEstimate on another ground: forgotten is what no hypothesis explains, and nothing else


NOISE = 0.02
EARLY = MagicFormula(peak_friction=0.3, peak_slip=0.05)
LATE = MagicFormula(peak_friction=0.9, peak_slip=0.15)


def drive(estimate, curve, count, rng):
    """Measurements from slips up to beyond the peak; mean and peak's slip after each."""
    seen = []
    for slip in rng.uniform(0.01, 0.2, count):
        friction = abs(curve.at(slip) + rng.normal(0.0, NOISE))
        estimate.update(np.array([slip]), np.array([friction]), np.array([NOISE]))
        seen.append((estimate.mean[0], estimate.peak_slip[0][0]))
    return np.array(seen).T


def test_on_another_ground_the_hypotheses_start_afresh():
    for first, second in ((EARLY, LATE), (LATE, EARLY)):
        moved, fresh = FrictionEstimate(1), FrictionEstimate(1)
        drive(moved, first, 300, np.random.default_rng(0))
        after, new = (drive(each, second, 30, np.random.default_rng(1)) for each in (moved, fresh))
        np.testing.assert_allclose(after[0, -1], new[0, -1], atol=0.02)
        np.testing.assert_allclose(after[1, -1], new[1, -1], atol=0.01)
