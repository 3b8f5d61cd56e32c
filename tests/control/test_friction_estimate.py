"""The estimate of a traction curve's peak: from slips that a limiter lets a wheel have."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.vehicle.friction_estimate import PEAK_SLIPS, FrictionEstimate
from safe_wrappers.envs.ground import MAGIC_FORMULA, MagicFormula


def learn(estimate, curve, slips, noise=0.02, seed=0, travel=0.01):
    rng = np.random.default_rng(seed)
    n = estimate.mean.size
    for slip in slips:
        measured = curve.friction(np.full(n, slip)) + noise * rng.normal(size=n)
        estimate.travel(np.full(n, travel))
        estimate.update(np.full(n, slip), measured, np.full(n, noise))


def test_knows_nothing_at_first():
    estimate = FrictionEstimate(3)
    assert estimate.mean.shape == estimate.std.shape == (3,)
    assert (estimate.std == 0.5).all()
    at, spread = estimate.peak_slip
    assert at == pytest.approx(np.mean(PEAK_SLIPS))
    assert spread == pytest.approx(np.std(PEAK_SLIPS))


@pytest.mark.parametrize("ground", ["dry", "wet", "snow", "ice"])
def test_finds_a_peak_it_has_been_over(ground):
    curve, estimate = MAGIC_FORMULA[ground], FrictionEstimate(4)
    learn(estimate, curve, np.linspace(0.02, 0.2, 120))
    assert (np.abs(estimate.mean - curve.peak_friction) <= 3.0 * estimate.std).all()
    assert (estimate.std < 0.04).all()
    at, spread = estimate.peak_slip
    assert (np.abs(at - curve.peak_slip) <= 2.5 * spread).all()


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


def test_small_slips_leave_the_height_open():
    """The slope alone fits a high peak far off as well as a low one nearby."""
    far, near = FrictionEstimate(1), FrictionEstimate(1)
    learn(far, MAGIC_FORMULA["dry"], np.full(50, 0.01))
    learn(near, MAGIC_FORMULA["dry"], np.linspace(0.01, 0.14, 50))
    assert far.std[0] > 4.0 * near.std[0]
    assert far.peak_slip[1][0] > 1.5 * near.peak_slip[1][0]


def test_the_interval_covers_the_truth():
    """Two standard deviations, over random curves of its shape and random slips up to their peaks."""
    rng, inside = np.random.default_rng(1), []
    for seed in range(200):
        slip = rng.uniform(0.06, 0.2)
        curve = MagicFormula(rng.uniform(0.1, 1.1), slip)
        estimate = FrictionEstimate(1)
        learn(estimate, curve, rng.uniform(0.0, 1.2 * slip, 40), seed=seed)
        inside.append(abs(estimate.mean[0] - curve.peak_friction) <= 2.0 * estimate.std[0])
    assert np.mean(inside) >= 0.9


def test_another_ground_is_noticed_at_once():
    estimate = FrictionEstimate(1)
    learn(estimate, MAGIC_FORMULA["dry"], np.linspace(0.02, 0.14, 80))
    assert estimate.mean[0] == pytest.approx(1.0, abs=0.05)
    learn(estimate, MAGIC_FORMULA["ice"], [0.12, 0.1, 0.1])
    assert estimate.mean[0] < 0.2


def test_travel_makes_unsure_and_only_travel():
    estimate = FrictionEstimate(2)
    learn(estimate, MAGIC_FORMULA["wet"], np.linspace(0.02, 0.14, 80))
    before = estimate.std
    estimate.travel(np.array([0.0, 3.0]))
    assert estimate.std[0] == before[0]
    assert estimate.std[1] > 2.0 * before[1]
    estimate.travel(np.array([0.0, 1e4]))
    assert estimate.std[1] >= 0.5  # of the prior, and what the hypotheses differ by
    assert estimate.peak_slip[0][1] == pytest.approx(np.mean(PEAK_SLIPS))


def test_a_wheel_without_a_measurement_stays_as_it_is():
    estimate = FrictionEstimate(2)
    learn(estimate, MAGIC_FORMULA["wet"], np.linspace(0.02, 0.14, 40))
    before = estimate.mean, estimate.std, estimate.weights
    estimate.update(np.array([0.1, 0.1]), np.array([5.0, 0.7]), np.array([np.inf, 0.02]))
    assert estimate.mean[0] == before[0][0]
    assert estimate.std[0] == before[1][0]
    np.testing.assert_array_equal(estimate.weights[0], before[2][0])
    assert estimate.mean[1] != before[0][1]


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 1e3), st.floats(1e-3, 10.0)), max_size=40))
def test_always_finite(measurements):
    estimate = FrictionEstimate(1)
    for slip, friction, noise in measurements:
        estimate.travel(np.array([slip]))
        estimate.update(np.array([slip]), np.array([friction]), np.array([noise]))
    assert np.isfinite(estimate.mean).all()
    assert (estimate.std > 0.0).all()
    assert estimate.weights.sum() == pytest.approx(1.0)
    assert PEAK_SLIPS[0] - 1e-9 <= estimate.peak_slip[0][0] <= PEAK_SLIPS[-1] + 1e-9
