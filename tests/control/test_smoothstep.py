"""Bumpless transfer: against numerical differentiation, brute force over s, and exact rational arithmetic."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from safe_wrappers.appendix.handover.blends import (
    blend,
    blend_rate,
    moving_blend_interval,
    shortest_moving_blend,
)
from safe_wrappers.control.handover.smoothstep import (
    SMOOTHSTEP_PEAK_RATE,
    shortest_latched_blend,
    smoothstep,
)
from safe_wrappers.errors import ConfigurationError

COMMAND = st.floats(-100, 100).map(lambda x: round(x, 9))  # steps that rational arithmetic can take in a test
LIMIT = st.floats(0.01, 100)
SHARE = st.one_of(st.floats(-1, 1, allow_subnormal=False), st.sampled_from([-1.0, 0.0, 1.0]))


def test_smoothstep_is_the_quintic_between_rests_and_clamped_outside():
    oracle = BPoly.from_derivatives([0, 1], [[0, 0, 0], [1, 0, 0]])
    s = np.linspace(0, 1, 101)
    for derivative in range(3):
        np.testing.assert_allclose(smoothstep(s, derivative), oracle(s, derivative), atol=1e-12)
    np.testing.assert_array_equal(smoothstep([-1.0, 0.0, 1.0, 7.0]), [0, 0, 1, 1])
    for derivative in (1, 2):
        np.testing.assert_array_equal(smoothstep([-1.0, 0.0, 1.0, 7.0], derivative), 0.0)
    assert smoothstep(0.5, 1) == SMOOTHSTEP_PEAK_RATE == smoothstep(np.linspace(0, 1, 10_001), 1).max()
    assert np.all(np.diff(smoothstep(np.linspace(0, 1, 100_001))) >= 0.0)


@given(COMMAND, COMMAND, st.floats(-0.5, 1.5))
def test_a_blend_stays_between_its_commands_and_ends_on_them_bit_for_bit(prior, new, s):
    found = blend(prior, new, s)
    assert min(prior, new) <= found <= max(prior, new)
    assert blend(prior, prior, s) == prior
    assert blend(prior, new, 0.0) == prior and blend(prior, new, 1.0) == new == blend(prior, new, 1.5)
    alpha = smoothstep(s)
    assert found == pytest.approx((1 - alpha) * prior + alpha * new, abs=1e-12)


@given(COMMAND, COMMAND, COMMAND, COMMAND, st.floats(0.05, 5), st.floats(0.01, 0.99))
def test_the_rate_of_a_blend_is_its_numerical_derivative(prior, prior_rate, new, new_rate, tau, s):
    def command(t):
        return blend(prior + prior_rate * t, new + new_rate * t, t / tau)

    t, h = s * tau, 1e-5 * tau
    numeric = (8 * (command(t + h) - command(t - h)) - (command(t + 2 * h) - command(t - 2 * h))) / (12 * h)
    exact = blend_rate(prior + prior_rate * t, prior_rate, new + new_rate * t, new_rate, s, tau)
    scale = 1 + (abs(prior) + abs(new)) / tau + abs(prior_rate) + abs(new_rate)
    assert exact == pytest.approx(numeric, abs=1e-8 * scale)


def exact_rate(prior, prior_rate, new, new_rate, s, tau):
    """The appendix's formula in rational arithmetic: no rounding."""
    p, rp, n, rn, s, tau = (Fraction(float(x)) for x in (prior, prior_rate, new, new_rate, s, tau))
    alpha = s**3 * (10 - 15 * s + 6 * s**2)
    step = n + rn * s * tau - p - rp * s * tau
    return 30 * s**2 * (1 - s) ** 2 * step / tau + (1 - alpha) * rp + alpha * rn


def worst_points(step, prior_rate, new_rate, limit):
    """Values of s around the one that binds, by brute force over the condition on w = 1 / tau."""
    s = np.linspace(0, 1, 4001)[1:-1]
    own = prior_rate + (new_rate - prior_rate) * (smoothstep(s) + s * smoothstep(s, 1))
    binding = np.minimum(
        np.where(step > 0, limit - own, limit + own) / (smoothstep(s, 1) * abs(step)), np.finfo(float).max
    )
    near = s[np.argmin(binding)]
    return np.concatenate([np.linspace(0, 1, 21), np.clip(near + np.linspace(-3e-4, 3e-4, 21), 0, 1)])


@given(COMMAND, COMMAND, LIMIT, SHARE, SHARE)
def test_no_returned_blend_time_ever_breaks_the_limit(prior, new, limit, first, second):
    prior_rate, new_rate = first * limit, second * limit
    shortest, longest = moving_blend_interval(prior, prior_rate, new, new_rate, limit)
    assert shortest == shortest_moving_blend(prior, prior_rate, new, new_rate, limit)
    step = new - prior
    assume(step != 0)  # without a step there is no blend
    assume(np.isfinite(shortest))
    assert 0 < shortest <= longest
    times = {float(shortest), float(longest), float(np.sqrt(shortest * min(longest, 1e6 * shortest)))}
    for tau in times - {np.inf}:
        for s in worst_points(step, prior_rate, new_rate, limit):
            assert abs(exact_rate(prior, prior_rate, new, new_rate, s, tau)) <= Fraction(limit)


def brute_force(prior, prior_rate, new, new_rate, limit):
    """Shortest and longest tau from the condition at 400,001 values of s, refined around the binding ones."""
    step, change = new - prior, new_rate - prior_rate

    def bounds(s):
        own = prior_rate + change * (smoothstep(s) + s * smoothstep(s, 1))
        a = smoothstep(s, 1) * step
        ends = np.sort([(limit - own) / a, (-limit - own) / a], axis=0)
        return ends[1], ends[0]

    s = np.linspace(0, 1, 40_001)[1:-1]
    high, low = bounds(s)
    at_high = np.clip(s[np.argmin(high)] + np.linspace(-5e-5, 5e-5, 40_001), 1e-9, 1 - 1e-9)
    at_low = np.clip(s[np.argmax(low)] + np.linspace(-5e-5, 5e-5, 40_001), 1e-9, 1 - 1e-9)
    return bounds(at_high)[0].min(), max(bounds(at_low)[1].max(), 0.0)


def test_shortest_and_longest_equal_brute_force():
    rng = np.random.default_rng(0)
    count = 300
    limit, prior, new = rng.uniform(0.5, 5, count), rng.normal(size=count), rng.normal(size=count)
    prior_rate, new_rate = rng.uniform(-1.05, 1.05, (2, count)) * limit
    prior_rate[:20] = 0.0
    new_rate[10:40] = 0.0
    new_rate[40:60] = prior_rate[40:60]
    shortest, longest = moving_blend_interval(prior, prior_rate, new, new_rate, limit)
    kinds = {"none": 0, "bounded": 0, "unbounded": 0}
    for i in range(count):
        high, low = brute_force(prior[i], prior_rate[i], new[i], new_rate[i], limit[i])
        possible = high > 0 and high >= low and max(abs(prior_rate[i]), abs(new_rate[i])) <= limit[i]
        assert np.isfinite(shortest[i]) == possible
        if not possible:
            assert longest[i] == np.inf
            kinds["none"] += 1
            continue
        assert shortest[i] == pytest.approx(1 / high, rel=1e-9)
        if low > 0:
            assert longest[i] == pytest.approx(1 / low, rel=1e-9)
            kinds["bounded"] += 1
        else:
            assert longest[i] == np.inf
            kinds["unbounded"] += 1
    assert min(kinds.values()) >= 20  # every kind was seen


@given(COMMAND, COMMAND, LIMIT)
def test_latched_commands_give_the_latched_formula(prior, new, limit):
    latched = shortest_latched_blend(new - prior, limit)
    assert latched == pytest.approx(1.875 * abs(new - prior) / limit, rel=1e-11)
    assert shortest_moving_blend(prior, 0.0, new, 0.0, limit) == pytest.approx(latched, rel=1e-11)
    if latched > 0:
        assert abs(exact_rate(prior, 0, new, 0, 0.5, latched)) <= Fraction(limit)
        assert abs(exact_rate(prior, 0, new, 0, 0.5, latched * (1 - 1e-11))) > Fraction(limit)


def test_the_latched_formula_is_too_short_for_a_moving_endpoint():
    limit = 2.0
    latched = shortest_latched_blend(1.0, limit)
    assert exact_rate(0.0, 0.5, 1.0, 0.5, 0.5, latched) > limit
    assert shortest_moving_blend(0.0, 0.5, 1.0, 0.5, limit) == pytest.approx(1.875 / 1.5)


def test_a_blend_may_be_too_long_or_impossible():
    # both within the limit of 2, but they drift apart, and the blend adds 7/9 of the drift
    assert np.isinf(shortest_moving_blend(0.0, 1.0, 1.0, 2.0, 2.0))
    # prior below its successor, but catching up: a long blend would cross over
    shortest, longest = moving_blend_interval(0.0, 1.0, -1.0, 2.0, 2.0)
    assert 0 < shortest < longest == pytest.approx(1.0)
    # an endpoint alone is too fast
    assert np.isinf(moving_blend_interval(0.0, 2.1, -1.0, 0.0, 2.0)).all()
    assert np.isinf(shortest_moving_blend(0.0, 0.0, 0.0, 2.1, 2.0))


def test_commands_that_meet_are_switched_at_once():
    assert moving_blend_interval(1.0, 0.0, 1.0, 0.0, 2.0) == (0.0, np.inf)
    assert moving_blend_interval(1.0, 1.0, 1.0, 2.0, 2.0) == (0.0, 0.0)  # any blend would overshoot
    assert shortest_latched_blend(0.0, 1.0) == 0.0
    # two commands that leave one point at rates 0 and r: a blend goes at up to 16/9 r
    assert moving_blend_interval(1.0, 0.0, 1.0, 2.0 * 9 / 16 * 1.001, 2.0) == (0.0, 0.0)
    assert moving_blend_interval(1.0, 0.0, 1.0, 2.0 * 9 / 16 * 0.999, 2.0) == (0.0, np.inf)
    s, rate = np.linspace(0, 1, 30_001), 1.0
    assert blend_rate(0.0, 0.0, rate * s, rate, s, 1.0).max() == pytest.approx(16 / 9 * rate, rel=1e-8)


def test_an_endpoint_exactly_at_the_limit():
    # leaving a ramp at the limit upwards: no room at the very start
    assert np.isinf(shortest_moving_blend(0.0, 2.0, 1.0, 0.0, 2.0))
    assert np.isfinite(shortest_moving_blend(0.0, 2.0, -1.0, 0.0, 2.0))


def test_blend_times_broadcast():
    rng = np.random.default_rng(0)
    prior, new = rng.normal(size=(2, 4, 1, 3))
    rate, limit = rng.uniform(-1, 1, (5, 3)), np.full(3, 1.5)
    together = moving_blend_interval(prior, rate, new, 0.0, limit)
    assert together[0].shape == together[1].shape == (4, 5, 3)
    for i, j, k in np.ndindex(4, 5, 3):
        alone = moving_blend_interval(prior[i, 0, k], rate[j, k], new[i, 0, k], 0.0, 1.5)
        np.testing.assert_allclose([x[i, j, k] for x in together], alone, rtol=1e-13)


@pytest.mark.parametrize("tiny", [1e-300, 1e-30, 1e-9])
def test_extreme_sizes_give_no_warning_and_no_nan(tiny):
    with np.errstate(all="raise", under="ignore"):
        for prior_rate in (0.0, tiny, -tiny, 1.0 - 1e-16):
            for step in (tiny, -tiny, 1e12):
                found = moving_blend_interval(0.0, prior_rate, step, 0.5, 1.0)
                assert not np.isnan(found).any() and (np.array(found) >= 0).all()


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: smoothstep(0.5, 3), "derivative of the smoothstep is 0, 1 or 2"),
        (lambda: shortest_latched_blend(1.0, 0.0), "rate_limit must be > 0"),
        (lambda: shortest_latched_blend(np.nan, 1.0), "step must be finite"),
        (lambda: shortest_latched_blend("far", 1.0), "step is a number"),
        (lambda: shortest_moving_blend(0, 0, 1, 0, -1.0), "rate_limit must be > 0"),
        (lambda: shortest_moving_blend(0, np.inf, 1, 0, 1.0), "prior_rate must be finite"),
        (lambda: shortest_moving_blend([0, 0], 0, [1, 1, 1], 0, 1.0), "broadcast together"),
    ],
)
def test_bad_input_is_refused_in_words(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()
