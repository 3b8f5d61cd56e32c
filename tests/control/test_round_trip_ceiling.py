"""The round-trip ceiling: the inequality in exact fractions, and operators who stop in time or too late."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from safe_wrappers.control.watchdog import longest_lease, round_trip_ceiling
from safe_wrappers.errors import ConfigurationError

SHORT = st.floats(0.0, 1.0)


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 50.0), st.floats(1e-2, 1e3), SHORT, SHORT, SHORT, SHORT, SHORT)
def test_it_is_the_largest_that_keeps_the_inequality(d, v, b, video, human, act, loc, gap):
    ceiling = float(round_trip_ceiling(d, v, b, video, human, act, loc, gap))
    exact_v = Fraction(v)
    braking_way = exact_v**2 / (2 * Fraction(b))
    late = Fraction(video) + Fraction(human) + Fraction(act)
    exact = (Fraction(d) - Fraction(loc) - Fraction(gap) - braking_way) / exact_v - late
    assert Fraction(ceiling) <= exact  # never late by a rounding
    spoilt = (d + loc + gap + float(braking_way)) / v + video + human + act
    assert float(exact) - ceiling <= 1e-13 * spoilt
    assume(ceiling > 0.0)
    assert ceiling == longest_lease(d, v, b, video + human + act, loc, gap)


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
    ceiling = float(round_trip_ceiling(d, *rest))
    assert ceiling > 0.09
    assert clearance_left(ceiling, d, *rest) == pytest.approx(0.0, abs=1e-9)
    assert clearance_left(ceiling, d, *rest) >= 0.0
    assert clearance_left(1.05 * ceiling, d, *rest) < 0.0
    for _ in range(20):  # jitter below the ceiling
        assert clearance_left(ceiling, d, *rest, rng) >= 0.0


def test_standing_receding_and_not_known():
    late = (0.1, 0.2, 0.05)
    assert round_trip_ceiling(1.0, 0.0, 1.0, *late) == np.inf
    assert round_trip_ceiling(1.0, -1.0, 1.0, *late) == np.inf
    assert round_trip_ceiling(0.1, -1.0, 1.0, *late, margin=0.1) == -np.inf
    assert round_trip_ceiling(1.0, 1.0, 0.0, *late) == -np.inf
    for place in range(6):
        for bad in (np.nan, np.inf):
            inputs = [1.0, 0.5, 1.0, *late]
            inputs[place] = bad
            assert round_trip_ceiling(*inputs) == -np.inf
    assert round_trip_ceiling(1.0, 0.5, 1.0, 1e308, 1e308, 1e308) == -np.inf


@pytest.mark.parametrize("name", ["video_s", "human_s", "act_s", "localisation", "margin"])
def test_what_would_raise_the_ceiling_by_mistake_is_refused(name):
    given_ = {"video_s": 1.0, "human_s": 1.0, "act_s": 1.0, name: -0.1}
    with pytest.raises(ConfigurationError, match=f"{name} must not be negative, got -0.1"):
        round_trip_ceiling(9.0, 1.0, 1.0, **given_)
