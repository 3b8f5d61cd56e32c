"""The round-trip ceiling: the inequality in exact fractions, and operators who stop in time or too late."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.watchdog import longest_lease

SHORT = st.floats(0.0, 1.0)


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 50.0), st.floats(1e-2, 1e3), SHORT, SHORT, SHORT, SHORT, SHORT)
def test_it_is_the_largest_that_keeps_the_inequality(d, v, b, video, human, act, loc, gap):
    ceiling = float(longest_lease(d, v, b, video + human + act, loc, gap))
    exact_v = Fraction(v)
    braking_way = exact_v**2 / (2 * Fraction(b))
    late = Fraction(video) + Fraction(human) + Fraction(act)
    exact = (Fraction(d) - Fraction(loc) - Fraction(gap) - braking_way) / exact_v - late
    assert Fraction(ceiling) <= exact  # never late by a rounding
    spoilt = (d + loc + gap + float(braking_way)) / v + video + human + act
    assert float(exact) - ceiling <= 1e-13 * spoilt


def clearance_left(trip_s, clearance, speed, braking, video, human, act, rng=None):
    """An obstacle shows up. A frame every millisecond shows it, then every millisecond a command says stop.

    Every packet takes half of the round trip; with `rng` between 0.3 of that and all of it, each for itself.
    """

    def first_to_arrive(sent_s):
        shares = [1.0] if rng is None else rng.uniform(0.3, 1.0, size=200)
        return min(sent_s + 1e-3 * k + 0.5 * share * trip_s for k, share in enumerate(shares))

    onset = first_to_arrive(first_to_arrive(video) + human) + act
    return clearance - speed * onset - 0.5 * speed**2 / braking


@pytest.mark.parametrize("seed", range(5))
def test_an_operator_at_the_ceiling_stops_and_one_five_percent_later_does_not(seed):
    rng = np.random.default_rng(seed)
    v, b = rng.uniform(0.3, 2.0), rng.uniform(1.0, 4.0)
    rest = (v, b, rng.uniform(0.0, 0.1), rng.uniform(0.15, 0.25), rng.uniform(0.0, 0.05))
    d = v * v / (2 * b) + v * (sum(rest[2:]) + rng.uniform(0.1, 1.0))
    ceiling = float(longest_lease(d, v, b, sum(rest[2:])))
    assert ceiling > 0.09
    assert clearance_left(ceiling, d, *rest) == pytest.approx(0.0, abs=1e-9)
    assert clearance_left(ceiling, d, *rest) >= 0.0
    assert clearance_left(1.05 * ceiling, d, *rest) < 0.0
    for _ in range(20):  # jitter below the ceiling
        assert clearance_left(ceiling, d, *rest, rng) >= 0.0
