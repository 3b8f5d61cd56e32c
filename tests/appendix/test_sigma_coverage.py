"""How often an error leaves k sigma: against scipy.stats, the extremal distributions and the inverses."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, laplace, norm, t, uniform

from safe_wrappers.appendix.estimation.sigma_coverage import (
    ASSUMPTIONS,
    chebyshev_tail,
    gaussian_tail,
    sigmas_for,
    unimodal_tail,
)
from safe_wrappers.errors import ConfigurationError, UnknownNameError

widths = st.floats(0.0, 20.0)
probabilities = st.floats(1e-12, 0.999)
dimensions = st.integers(1, 6)


@given(st.floats(0.0, 8.0), dimensions)
def test_the_gaussian_tail_is_scipy_s(k, d):
    assert gaussian_tail(k, d) == pytest.approx(chi2.sf(k**2, d), rel=1e-9)
    assert gaussian_tail(k) == pytest.approx(2 * norm.sf(k), rel=1e-9)


def test_the_numbers_everybody_knows():
    np.testing.assert_allclose(gaussian_tail([1, 2, 3]), [0.3173, 0.0455, 0.0027], rtol=2e-3)
    np.testing.assert_allclose(gaussian_tail([1, 2, 3], 2), np.exp([-0.5, -2.0, -4.5]))
    np.testing.assert_allclose(chebyshev_tail([1, 2, 3]), [1, 1 / 4, 1 / 9])
    np.testing.assert_allclose(chebyshev_tail([1, 2, 3], 2), [1, 1 / 2, 2 / 9])
    np.testing.assert_allclose(unimodal_tail([2, 3]), [1 / 9, 4 / 81])


@given(widths, dimensions)
def test_no_k_and_no_dimension_leave_the_order_of_the_assumptions(k, d):
    assert 0.0 <= gaussian_tail(k, d) <= chebyshev_tail(k, d) <= 1.0
    assert gaussian_tail(k) <= unimodal_tail(k) + 1e-15
    assert unimodal_tail(k) <= chebyshev_tail(k)


@pytest.mark.parametrize(("k", "d"), [(1.5, 1), (3.0, 1), (2.0, 3), (4.0, 2)])
def test_one_distribution_reaches_the_distribution_free_bound(k, d):
    # All the probability at 0 but d / k^2, spread over +-k along each axis: covariance 1, exactly this much outside.
    points = np.concatenate([np.zeros((1, d)), k * np.eye(d), -k * np.eye(d)])
    outside = d / k**2
    weights = np.array([1 - outside, *[outside / (2 * d)] * (2 * d)])
    np.testing.assert_allclose((points.T * weights) @ points, np.eye(d), atol=1e-12)
    left = weights[np.linalg.norm(points, axis=1) >= k].sum()
    assert chebyshev_tail(k, d) == pytest.approx(left)


@pytest.mark.parametrize("k", [math.sqrt(8 / 3), 1.8, 2.5, 4.0])
def test_a_single_peaked_distribution_reaches_the_unimodal_bound(k):
    # Some probability at 0, the rest uniform on [-1, 1].
    spread = np.linspace(0, 1, 4001)[1:]
    outside = spread * np.maximum(1 - k * np.sqrt(spread / 3), 0)
    assert outside.max() <= unimodal_tail(k) + 1e-15
    assert outside.max() == pytest.approx(float(unimodal_tail(k)), rel=1e-5)


@pytest.mark.parametrize("k", [1.0, 1.1, 1.3, 1.6])
def test_below_its_usual_range_too_where_distance_is_from_anywhere(k):
    # Some probability at the peak 1, the rest uniform on [-b, 1]; k in units of the root mean square.
    peak, b = np.linspace(0, 1, 2001)[:, None], np.linspace(0, 1, 401)
    reach = k * np.sqrt(peak + (1 - peak) * (1 + b**3) / (3 * (1 + b)))
    beyond = np.maximum(1 - reach, 0) + np.maximum(b - reach, 0)
    outside = peak * (reach <= 1) + (1 - peak) * beyond / (1 + b)
    assert outside.max() <= unimodal_tail(k) + 1e-12
    assert outside.max() == pytest.approx(float(unimodal_tail(k)), rel=1e-2)


@pytest.mark.parametrize("error", [norm(), laplace(), uniform(-1, 2), t(3)])
def test_single_peaked_errors_keep_the_unimodal_bound(error):
    k = np.linspace(0.1, 8, 60)
    assert (2 * error.sf(k * error.std()) <= unimodal_tail(k)).all()


def test_a_heavy_tail_breaks_the_gaussian_promise_and_keeps_the_others():
    heavy = t(3)
    outside = 2 * heavy.sf(4 * heavy.std())
    assert outside > 50 * gaussian_tail(4.0)
    assert outside <= unimodal_tail(4.0) <= chebyshev_tail(4.0)


@given(probabilities, dimensions)
def test_the_inverses_are_inverse(p, d):
    assert gaussian_tail(sigmas_for(p, d, "gaussian"), d) == pytest.approx(p, rel=1e-9)
    assert chebyshev_tail(sigmas_for(p, d, "distribution-free"), d) == pytest.approx(p, rel=1e-9)
    assert unimodal_tail(sigmas_for(p, 1, "unimodal")) == pytest.approx(p, rel=1e-9)


def test_arrays_keep_their_shape_and_scalars_are_scalars():
    p = np.array([[0.3, 0.1], [0.01, 1e-6]])
    for assume in ASSUMPTIONS:
        assert sigmas_for(p, assume=assume).shape == (2, 2)
        assert sigmas_for(0.1, assume=assume).shape == ()
    for tail in (gaussian_tail, chebyshev_tail, unimodal_tail):
        assert tail(p).shape == (2, 2) and tail(1.0).shape == ()
    assert sigmas_for(0.05) == pytest.approx(1.959964, rel=1e-6)


def test_an_unknown_assumption_lists_those_that_there_are():
    with pytest.raises(UnknownNameError, match=r"'gaussian', 'unimodal', 'distribution-free', got 'normal'"):
        sigmas_for(0.1, assume="normal")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: gaussian_tail(-1.0), ["sigmas", "-1.0"]),
        (lambda: unimodal_tail(math.nan), ["sigmas", "finite"]),
        (lambda: chebyshev_tail(1.0, 0), ["dimensions", "0"]),
        (lambda: gaussian_tail(1.0, 1.5), ["dimensions", "1.5"]),
        (lambda: sigmas_for(0.0), ["probability", "0.0"]),
        (lambda: sigmas_for([0.5, 1.0]), ["probability", "1.0"]),
        (lambda: sigmas_for(0.1, 2, "unimodal"), ["one dimension", "2"]),
    ],
)
def test_bad_input_is_refused(call, words):
    with pytest.raises(ConfigurationError) as refusal:
        call()
    assert all(word in str(refusal.value) for word in words)
