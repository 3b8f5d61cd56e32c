"""Quintic and Hermite segments against scipy, linear algebra and dense sampling; smoothstep in its own file."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.polynomial.polynomial import polyder, polyval
from scipy.interpolate import BPoly, CubicHermiteSpline

from safe_wrappers.control.handover.interior import (
    interior_extrema,
    knot_acceleration_step,
    knot_torque_step,
)
from safe_wrappers.control.handover.splines import hermite_series, quintic_coefficients
from safe_wrappers.errors import ConfigurationError

DURATION = st.floats(0.02, 10.0)
STATES = hnp.arrays(np.float64, 6, elements=st.floats(-10, 10, allow_subnormal=False))


def evaluate(coefficients, t, derivative=0):
    """Of segments, shape (..., 6), at times (k,): shape (..., k)."""
    return polyval(np.asarray(t), np.moveaxis(polyder(coefficients, derivative, axis=-1), -1, 0))


def segments(count, seed=0):
    rng = np.random.default_rng(seed)
    ends, span = rng.normal(size=(6, count)), rng.uniform(0.05, 4.0, count)
    return ends, span, quintic_coefficients(*ends, span)


@given(STATES, DURATION)
def test_quintic_is_scipy_s_polynomial_from_derivatives(ends, span):
    oracle = BPoly.from_derivatives([0.0, span], [ends[:3], ends[3:]])
    coefficients = quintic_coefficients(*ends, span)
    t = np.linspace(0, span, 9)
    for derivative in range(4):
        # the size of what is added up, not of the sum
        scale = np.abs(coefficients * span ** np.arange(6)).sum() * (5 / span) ** derivative + 1e-12
        found = evaluate(coefficients, t, derivative)
        np.testing.assert_allclose(found, oracle(t, derivative), rtol=0, atol=1e-11 * scale)


@given(STATES, DURATION)
def test_quintic_solves_the_boundary_value_matrix(ends, span):
    closed = quintic_coefficients(*ends, span)
    t = span
    matrix = [
        [1, 0, 0, 0, 0, 0],
        [0, 1, 0, 0, 0, 0],
        [0, 0, 2, 0, 0, 0],
        [1, t, t**2, t**3, t**4, t**5],
        [0, 1, 2 * t, 3 * t**2, 4 * t**3, 5 * t**4],
        [0, 0, 2, 6 * t, 12 * t**2, 20 * t**3],
    ]
    weights = span ** np.arange(6)  # solved in normalised time, so that the oracle itself is accurate
    solved = np.linalg.solve(matrix / weights, ends) / weights
    np.testing.assert_allclose(
        closed * weights, solved * weights, rtol=0, atol=1e-10 * (1 + np.abs(ends).max() * (1 + span**2))
    )


def test_times_come_last_and_batches_are_element_by_element():
    ends, span, _ = segments(6)
    ends, span = ends.reshape(6, 2, 3), span.reshape(2, 3)
    together = quintic_coefficients(*ends, span)
    assert together.shape == (2, 3, 6)
    t = np.linspace(0, 0.05, 4)
    values = evaluate(together, t, 1)
    assert values.shape == (2, 3, 4)
    found = interior_extrema(together, span, 2)
    for i in np.ndindex(2, 3):
        alone = quintic_coefficients(*ends[(slice(None), *i)], span[i])
        np.testing.assert_array_equal(together[i], alone)
        np.testing.assert_array_equal(values[i], evaluate(alone, t, 1))
        np.testing.assert_allclose(
            [x[i] for x in found], interior_extrema(alone, span[i], 2), rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("derivative", range(4))
def test_extrema_are_never_less_than_the_densest_sampling_finds(derivative):
    _, span, coefficients = segments(200, seed=derivative)
    found = interior_extrema(coefficients, span, derivative)
    unit = np.linspace(0, 1, 20_001)
    for i, duration in enumerate(span):
        sampled = evaluate(coefficients[i], unit * duration, derivative)
        scale = np.abs(sampled).max()
        assert -1e-13 <= (found.maximum[i] - sampled.max()) / scale <= 3e-8  # the samples' own grid
        assert -1e-13 <= (sampled.min() - found.minimum[i]) / scale <= 3e-8
        for at, extreme in ((found.minimum_at, found.minimum), (found.maximum_at, found.maximum)):
            assert 0 <= at[i] <= duration
            assert evaluate(coefficients[i], at[i], derivative) == pytest.approx(
                extreme[i], abs=1e-12 * scale
            )
        assert found.peak[i] == max(abs(found.minimum[i]), abs(found.maximum[i]))


def test_extrema_of_a_rest_to_rest_move_are_the_textbook_s():
    way, span = 3.0, 2.0
    c = quintic_coefficients(0, 0, 0, way, 0, 0, span)
    position, velocity, acceleration, jerk = (interior_extrema(c, span, d) for d in range(4))
    assert (position.minimum, position.maximum) == (0.0, pytest.approx(way))
    assert velocity.maximum == pytest.approx(1.875 * way / span) and velocity.maximum_at == pytest.approx(1.0)
    assert acceleration.peak == pytest.approx(10 / np.sqrt(3) * way / span**2)
    assert acceleration.maximum_at == pytest.approx((0.5 - np.sqrt(3) / 6) * span)
    assert jerk.maximum == pytest.approx(60 * way / span**3)
    assert jerk.minimum == pytest.approx(-30 * way / span**3) and jerk.minimum_at == pytest.approx(1.0)


@pytest.mark.parametrize("degree", range(6))
def test_extrema_with_leading_coefficients_of_zero(degree):
    c = np.zeros(6)
    c[: degree + 1] = np.random.default_rng(degree).normal(size=degree + 1)
    t = np.linspace(0, 1.5, 30_001)
    for derivative in range(4):
        with np.errstate(all="raise"):
            found = interior_extrema(c, 1.5, derivative)
        sampled = evaluate(c, t, derivative)
        assert found.maximum == pytest.approx(sampled.max(), abs=1e-6)
        assert found.minimum == pytest.approx(sampled.min(), abs=1e-6)
        assert found.maximum >= sampled.max() - 1e-12 and found.minimum <= sampled.min() + 1e-12


def test_an_overshoot_lies_inside_although_the_ends_are_at_rest_and_equal():
    c = quintic_coefficients(0, 2, 0, 0, 2, 0, 1.0)  # same place, same speed: it has to swing back
    assert interior_extrema(c, 1.0, 0).peak > 0.05
    assert interior_extrema(c, 1.0, 2).peak > 10.0


# cubic Hermite


def frames(joints=3, seed=0):
    """A smooth motion seen by a camera: 30 Hz with jitter."""
    rng = np.random.default_rng(seed)
    times = np.arange(16) / 30 + rng.uniform(-0.005, 0.005, 16)
    phase, rate = rng.uniform(0, 6, (joints, 1)), rng.uniform(2, 6, (joints, 1))
    return times, np.sin(rate * times + phase), rate * np.cos(rate * times + phase), (rate, phase)


def test_a_30_hz_stream_at_1_khz_is_scipy_s_spline_and_close_to_the_motion():
    times, q, v, (rate, phase) = frames()
    ticks = np.arange(int(times[0] * 1000) + 1, int(times[-1] * 1000)) / 1000
    oracle = CubicHermiteSpline(times, q, v, axis=-1)
    for derivative in range(3):
        found = hermite_series(times, q, v, ticks, derivative)
        assert found.shape == (3, len(ticks))
        np.testing.assert_allclose(found, oracle(ticks, derivative), rtol=1e-9, atol=1e-9)
    error = hermite_series(times, q, v, ticks) - np.sin(rate * ticks + phase)
    assert np.abs(error).max() <= (6.0 * np.diff(times).max()) ** 4 / 384 * 1.001  # Hermite's own bound


def test_a_series_passes_through_its_samples_with_their_velocities():
    times, q, v, _ = frames()
    np.testing.assert_allclose(hermite_series(times, q, v, times), q, rtol=0, atol=1e-14)
    np.testing.assert_allclose(hermite_series(times, q, v, times, 1), v, rtol=0, atol=1e-12)
    assert hermite_series(times, q, v, times[3]).shape == (3,)


def test_at_a_knot_the_acceleration_is_that_of_the_segment_after_it():
    times, q, v = np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 1.0]), np.zeros(3)
    np.testing.assert_allclose(hermite_series(times, q, v, times, 2), [6.0, 0.0, 0.0], atol=1e-12)
    assert hermite_series(times, q, v, 1.0 - 1e-9, 2) == pytest.approx(-6.0)


def test_the_torque_steps_at_inner_knots_are_those_of_the_spline():
    times, q, v, _ = frames()
    v = v + np.random.default_rng(2).normal(0, 0.2, v.shape)  # measured velocities do not fit the positions
    oracle = CubicHermiteSpline(times, q, v, axis=-1)
    inner = times[1:-1]
    step = oracle(inner + 1e-9, 2) - oracle(inner - 1e-9, 2)
    assert np.median(np.abs(step)) > 10.0  # rad/s^2
    np.testing.assert_allclose(knot_acceleration_step(times, q, v), step, atol=1e-4)
    rng = np.random.default_rng(1)
    root = rng.normal(size=(len(inner), 3, 3))
    matrices = root @ root.swapaxes(-1, -2) + np.eye(3)
    torque = knot_torque_step(matrices, times, q, v)
    for k in range(len(inner)):
        np.testing.assert_allclose(torque[:, k], matrices[k] @ step[:, k], atol=1e-3)
    same = knot_torque_step(matrices[0], times, q, v)
    np.testing.assert_allclose(same[:, 5], matrices[0] @ step[:, 5], atol=1e-3)
    np.testing.assert_allclose(knot_torque_step(0.5, times, q[0], v[0]), 0.5 * step[0], atol=1e-4)
    both = knot_torque_step(matrices, times, np.stack([q, 2 * q]), np.stack([v, 2 * v]))
    np.testing.assert_allclose(both, [torque, 2 * torque], rtol=1e-12)


def test_a_cubic_motion_has_no_steps():
    times = np.array([0.0, 0.3, 0.4, 1.0])
    q, v = times**3 - times, 3 * times**2 - 1
    np.testing.assert_allclose(knot_acceleration_step(times, q, v), 0.0, atol=1e-12)


TIMES, Q, V, _ = frames()


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: quintic_coefficients(0, 0, 0, 1, 0, 0, 0.0), "duration is a time in seconds, > 0"),
        (lambda: quintic_coefficients(0, 0, 0, 1, 0, 0, [1.0, -1.0]), "duration"),
        (lambda: quintic_coefficients(0, 0, 0, 1, 0, 0, np.nan), "duration"),
        (lambda: quintic_coefficients(0, 0, 0, 1, 0, 0, "fast"), "duration is a time in seconds, got 'fast'"),
        (lambda: quintic_coefficients(0, np.inf, 0, 1, 0, 0, 1.0), "v0 must be finite"),
        (lambda: quintic_coefficients(0, "x", 0, 1, 0, 0, 1.0), "v0 is a number"),
        (lambda: quintic_coefficients([0, 0], 0, 0, [1, 1, 1], 0, 0, 1.0), "broadcast together"),
        (lambda: interior_extrema(np.zeros(6), 1.0, 4), "derivative is 0, 1, 2 or 3"),
        (lambda: interior_extrema(np.zeros(6), 0.0, 1), "duration"),
        (lambda: hermite_series(TIMES[::-1], Q, V, 0.1), "strictly rising"),
        (lambda: hermite_series(TIMES[:1], Q[:, :1], V[:, :1], 0.0), "k >= 2"),
        (lambda: hermite_series(TIMES, Q[:, 1:], V, 0.1), "one entry per time"),
        (lambda: hermite_series(TIMES, Q * np.nan, V, 0.1), "must be finite"),
        (lambda: hermite_series(TIMES, Q, V, TIMES[-1] + 0.001), "nothing is extrapolated"),
        (lambda: hermite_series(TIMES, Q, V, np.nan), "nothing is extrapolated"),
        (lambda: knot_torque_step(np.eye(2), TIMES, Q, V), "with 3 joints and 14 inner knots"),
        (lambda: knot_torque_step(np.eye(3), TIMES, Q[0], V[0]), "inertia is one number"),
    ],
)
def test_bad_input_is_refused_in_words(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()
