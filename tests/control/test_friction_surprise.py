"""FrictionEstimate on another ground: forgotten is what no hypothesis explains, and nothing else."""

import numpy as np

from safe_wrappers.control.vehicle.friction_estimate import FrictionEstimate
from safe_wrappers.envs.ground import MagicFormula

NOISE = 0.02
EARLY = MagicFormula(peak_friction=0.3, peak_slip=0.05)
LATE = MagicFormula(peak_friction=0.9, peak_slip=0.15)


def drive(estimate, curve, count, rng):
    """Measurements from slips up to beyond the peak; mean, standard deviation and peak's slip after each."""
    seen = []
    for slip in rng.uniform(0.01, 0.2, count):
        friction = abs(curve.at(slip) + rng.normal(0.0, NOISE))
        estimate.update(np.array([slip]), np.array([friction]), np.array([NOISE]))
        seen.append((estimate.mean[0], estimate.std[0], estimate.peak_slip[0][0]))
    return np.array(seen).T


def test_a_ground_that_one_hypothesis_does_not_explain_is_no_other_ground():
    mean, std, slip = drive(FrictionEstimate(1), LATE, 200, np.random.default_rng(0))
    np.testing.assert_allclose(mean[50:], 0.9, atol=0.05)
    assert (std[50:] < 0.02).all()
    np.testing.assert_allclose(slip[50:], 0.15, atol=0.01)


def test_on_another_ground_the_hypotheses_start_afresh():
    for first, second in ((EARLY, LATE), (LATE, EARLY)):
        moved, fresh = FrictionEstimate(1), FrictionEstimate(1)
        drive(moved, first, 300, np.random.default_rng(0))
        after, new = (drive(each, second, 30, np.random.default_rng(1)) for each in (moved, fresh))
        np.testing.assert_allclose(after[0, -1], new[0, -1], atol=0.02)
        np.testing.assert_allclose(after[2, -1], new[2, -1], atol=0.01)


def test_every_update_is_read_anew():
    estimate = FrictionEstimate(1)
    read = drive(estimate, LATE, 20, np.random.default_rng(3))
    unread = FrictionEstimate(1)
    rng = np.random.default_rng(3)
    slips = rng.uniform(0.01, 0.2, 20)
    for slip in slips:
        friction = abs(LATE.at(slip) + rng.normal(0.0, NOISE))
        unread.update(np.array([slip]), np.array([friction]), np.array([NOISE]))
    np.testing.assert_array_equal(read[:, -1], [unread.mean[0], unread.std[0], unread.peak_slip[0][0]])
