"""Manipulability against SVD and exact determinants; its gradient by differences, validated thresholds."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safe_wrappers.control.barriers import (
    manipulability,
    validated_threshold,
    worst_joint_rates,
)
from safe_wrappers.errors import ConfigurationError

numbers = st.floats(-10.0, 10.0).map(lambda v: v if abs(v) > 1e-30 else 0.0)
wide = st.tuples(st.integers(1, 4), st.integers(0, 4)).map(lambda s: (s[0], s[0] + s[1]))
jacobians = wide.flatmap(lambda shape: arrays(np.float64, shape, elements=numbers))


def exact(jacobian):
    """`sqrt(det(J J'))` with the determinant in fractions: no rounding but in the root."""
    rows = [[Fraction(float(v)) for v in row] for row in jacobian]
    square = [[sum(a * b for a, b in zip(r, s, strict=True)) for s in rows] for r in rows]
    determinant = Fraction(1)
    for i in range(len(square)):
        pivot = next((k for k in range(i, len(square)) if square[k][i]), None)
        if pivot is None:
            return 0.0
        if pivot != i:
            square[i], square[pivot] = square[pivot], square[i]
            determinant = -determinant
        determinant *= square[i][i]
        for k in range(i + 1, len(square)):
            share = square[k][i] / square[i][i]
            square[k] = [a - share * b for a, b in zip(square[k], square[i], strict=True)]
    return float(np.sqrt(float(determinant)))


# w ------------------------------------------------------------------------------------------------------------


@given(jacobians)
def test_it_is_the_product_of_the_singular_values_and_never_below_zero_or_no_number(jacobian):
    w = manipulability(jacobian)
    scale = np.prod(np.linalg.norm(jacobian, axis=1))
    assert w >= 0.0 and w <= scale * (1.0 + 1e-12)  # Hadamard
    product = np.prod(np.linalg.svd(jacobian, compute_uv=False))
    assert w == pytest.approx(product, rel=1e-9, abs=1e-14 * np.linalg.norm(jacobian) ** len(jacobian))


@pytest.mark.parametrize(
    "jacobian",
    [
        np.zeros((2, 4)),
        [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]],
        [[1.0, 0.1, 0.3], [0.7, 0.3, 0.2], [1.7, 0.4, 0.5]],  # the third row is the sum of the others
        [[0.0, 0.0], [1.0, 1.0]],
    ],
)
def test_it_is_zero_at_rank_loss_but_for_rounding(jacobian):
    assert manipulability(jacobian) == pytest.approx(
        exact(jacobian), abs=1e-15 * np.prod(np.linalg.norm(jacobian, axis=1))
    )
    assert np.isinf(worst_joint_rates(jacobian)).all()


# The ellipsoid, and what joint rates a twist takes ------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
def test_the_worst_rates_are_reached_by_a_twist_and_exceeded_by_none(seed):
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(3, 5))
    worst = worst_joint_rates(jacobian)
    twists = rng.normal(size=(500, 3))
    twists /= np.linalg.norm(twists, axis=1, keepdims=True)
    inverse = np.linalg.pinv(jacobian)
    rates = twists @ inverse.T
    np.testing.assert_allclose(np.einsum("mn,sn->sm", jacobian, rates), twists, atol=1e-9)
    assert (np.abs(rates) <= worst * (1.0 + 1e-9)).all()
    for j in range(5):
        hardest = inverse[j] / np.linalg.norm(inverse[j])
        assert inverse[j] @ hardest == pytest.approx(worst[j])
    smallest = np.linalg.svd(jacobian, compute_uv=False)[-1]
    assert np.linalg.norm(rates, axis=1).max() <= 1.0 / smallest + 1e-9
    assert worst.max() <= 1.0 / smallest + 1e-9
    # Of the least norm: any other rates with the same twist are longer.
    other = rates[0] + rng.normal(size=5) @ (np.eye(5) - inverse @ jacobian)
    assert np.linalg.norm(other) >= np.linalg.norm(rates[0])


# A validated threshold ----------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 5.0))
def test_no_sample_above_the_threshold_needs_more_and_no_smaller_number_would_do(seed, limit):
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(200, 2, 3))
    w = np.array([np.prod(np.linalg.svd(j, compute_uv=False)) for j in samples])
    need = np.array([np.linalg.norm(np.linalg.pinv(j), axis=1).max() for j in samples])
    if need[np.argmax(w)] > limit:
        with pytest.raises(ConfigurationError, match="no threshold on w keeps the rate limit"):
            validated_threshold(samples, 1.0, limit)
        return
    found = validated_threshold(samples, 1.0, limit)
    assert (need[w > found * (1.0 + 1e-9)] <= limit).all()  # its w is of another factorisation
    if (need > limit).any():
        assert (need[w > found * (1.0 - 1e-9)] > limit).any()
    else:
        assert found == pytest.approx(w.min())
    assert validated_threshold(samples, 0.5, limit / 2.0) == found


def test_of_a_jacobian_with_a_nan_nothing_is_said():
    jacobians = np.array([np.eye(2, 3), np.eye(2, 3)])
    jacobians[0, 1, 2] = np.nan
    assert np.isnan(manipulability(jacobians)).tolist() == [True, False]
