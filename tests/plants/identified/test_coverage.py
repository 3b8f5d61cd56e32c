"""The monitor: its martingale step by step, its false alarms, and what it finds."""

import itertools

import numpy as np
import pytest
from scipy.stats import binom

from safe_wrappers.plants.identified import Coverage, allowed_misses, upper_bound


@pytest.mark.parametrize(("scores", "rate"), [(9, 0.1), (60, 0.1), (40, 0.3)])
def test_evidence_is_a_product_of_predictive_probabilities(scores, rate):
    coverage = Coverage(scores, rate)
    misses = np.random.default_rng(scores).random(60) < 0.4
    # Polya's urn: the next miss under exchangeability, and under each of 20 larger rates.
    larger = rate + (1.0 - rate) * (np.arange(20) + 0.5) / 20.0
    weights, declared = np.ones(20), 1.0
    found, allowed = 0, allowed_misses(scores, rate)
    for judged, miss in enumerate(misses):
        next_miss = (allowed + found) / (scores + 1 + judged)
        declared *= next_miss if miss else 1.0 - next_miss
        weights *= larger if miss else 1.0 - larger
        found += miss
        assert coverage.evidence(found, judged + 1) == pytest.approx(
            np.log(weights.mean() / declared), abs=1e-9
        )


def test_the_evidence_is_fair_under_exchangeability():
    coverage = Coverage(19, 0.1)
    # The mean of the next value is the present one, whatever has happened so far.
    for missed, judged in itertools.product(range(6), range(6)):
        if missed > judged:
            continue
        p = (2 + missed) / (20 + judged)
        ahead = p * np.exp(coverage.evidence(missed + 1, judged + 1))
        ahead += (1.0 - p) * np.exp(coverage.evidence(missed, judged + 1))
        assert ahead == pytest.approx(np.exp(coverage.evidence(missed, judged)), rel=1e-9)


def test_false_alarms_are_as_rare_as_promised_and_a_doubled_rate_is_found():
    draw = np.random.default_rng(0)
    trials, steps, n = 2000, 300, 60
    counts = np.arange(1, steps + 1)
    alarms, found = 0, 0
    for _ in range(trials):
        scores = draw.standard_exponential(n + steps)
        bound = upper_bound(scores[:n], 0.1)
        coverage = Coverage(n, 0.1)
        alarms += (coverage.evidence(np.cumsum(scores[n:] > bound), counts) > np.log(1000.0)).any()
        found += (coverage.evidence(np.cumsum(3.0 * scores[n:] > bound), counts) > np.log(1000.0)).any()
    assert alarms <= binom.ppf(0.9999, trials, 0.001)
    assert found > 0.95 * trials


def test_a_lost_coverage_stays_lost_until_the_next_episode():
    coverage = Coverage(60, 0.1)
    for _ in range(30):
        coverage.judge(False)
    assert coverage.lost and (coverage.judged, coverage.missed) == (30, 30)
    for _ in range(3000):
        coverage.judge(True)
    assert coverage.lost and coverage.missed == 30
    coverage.start()
    assert not coverage.lost and coverage.judged == coverage.missed == 0
    for _ in range(1000):
        coverage.judge(True)
    assert not coverage.lost


def test_what_known_episodes_do_is_no_alarm():
    gust = np.ones(100, dtype=bool)
    gust[20:40] = False
    plain, knowing = Coverage(60, 0.1), Coverage(60, 0.1)
    knowing.set_alarm([np.ones(100, dtype=bool), gust])
    for held in gust:
        plain.judge(bool(held))
        knowing.judge(bool(held))
    assert plain.lost and not knowing.lost
    knowing.start()
    for held in (gust[:40], gust[20:40]):
        for one in held:
            knowing.judge(bool(one))
    assert knowing.lost
