"""Conformal bounds: the rank against whole numbers, and the miss rate over many drawings."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from safe_wrappers.plants.identified import allowed_misses, upper_bound

RATES = st.tuples(st.integers(1, 99), st.just(100)) | st.tuples(st.integers(1, 6), st.just(7))


@given(RATES, st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_the_bound_is_the_smallest_score_that_enough_scores_do_not_exceed(rate, n, seed):
    exact = Fraction(*rate)
    scores = np.random.default_rng(seed).integers(0, 50, n).astype(float)  # with ties
    wanted = (n + 1) * (1 - exact)
    fits = [s for s in sorted(scores) if int((scores <= s).sum()) >= wanted]
    assert upper_bound(scores, float(exact)) == (fits[0] if fits else math.inf)
    assert math.isfinite(upper_bound(scores, float(exact))) == ((n + 1) * exact >= 1)
    assert allowed_misses(n, float(exact)) == math.floor((n + 1) * exact)


def test_what_is_no_number_counts_as_infinite():
    assert upper_bound(np.array([np.nan, 1.0, 2.0]), 0.5) == 2.0
    assert upper_bound(np.array([np.nan, np.nan, 2.0]), 0.5) == math.inf


@pytest.mark.parametrize(("n", "rate"), [(9, 0.1), (30, 0.1), (50, 0.2), (100, 0.05)])
def test_the_next_score_is_above_as_often_as_was_promised(n, rate):
    draw = np.random.default_rng(n)
    trials = 20_000
    misses = 0
    for _ in range(trials):
        scores = draw.standard_cauchy(n + 1)
        misses += scores[-1] > upper_bound(scores[:-1], rate)
    exact = allowed_misses(n, rate) / (n + 1)
    low, high = binom.interval(0.9999, trials, exact)
    assert low <= misses <= high and exact <= rate
