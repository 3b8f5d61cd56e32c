"""Relative degree on textbook systems; manipulability by SVD, and validated thresholds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safe_wrappers.control.barriers import (
    manipulability,
    relative_degree,
    validated_threshold,
    worst_joint_rates,
)
from safe_wrappers.errors import ConfigurationError

SIZES = [1e-12, 1e-3, 1.0, 1e9]


@pytest.mark.parametrize("scale", SIZES)
@pytest.mark.parametrize("of_control", [1e-9, 1.0, 1e9])
def test_relative_degree_does_not_depend_on_the_units_of_h_and_of_the_control(scale, of_control):
    for order in (1, 2, 3):
        # x1' = x2, ..., xn' = u; a second control acts on nothing.
        shift, last = np.eye(order, k=1), np.eye(order)[:, -1:]
        chain = (lambda x, a=shift: a @ x), (lambda x, b=last: np.hstack([b * of_control, 0.0 * b]))
        for bend in (0.0, 0.3):
            for x in (np.full(order, 0.4), np.linspace(-0.5, 1.0, order)):
                barrier = lambda x, bend=bend: scale * (2.0 - x[0] - bend * x[0] ** 2)  # noqa: E731
                assert relative_degree(barrier, *chain, x) == order
        assert relative_degree(lambda x: scale * (1.0 - x[-1]), *chain, np.full(order, 0.4)) == 1
    apart = (lambda x: np.array([-x[0], x[1]])), (lambda x: np.array([[0.0], [of_control]]))
    for never in (lambda x: 1.0 - x[0], lambda x: np.cos(x[0]), lambda x: 1.0):
        assert relative_degree(lambda x, h=never: scale * h(x), *apart, [0.3, 0.2]) is None


numbers = st.floats(-10.0, 10.0).map(lambda v: v if abs(v) > 1e-30 else 0.0)
wide = st.tuples(st.integers(1, 4), st.integers(0, 4)).map(lambda s: (s[0], s[0] + s[1]))
jacobians = wide.flatmap(lambda shape: arrays(np.float64, shape, elements=numbers))


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
        np.ones((3, 2)),  # fewer joints than the task has directions
    ],
)
def test_it_is_zero_at_rank_loss_but_for_rounding(jacobian):
    assert manipulability(jacobian) <= 1e-15 * np.prod(np.linalg.norm(jacobian, axis=1))
    assert np.isinf(worst_joint_rates(jacobian)).all()


@given(st.integers(0, 2**32 - 1))
def test_the_worst_rates_are_reached_by_a_twist_and_exceeded_by_none(seed):
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(3, 5))
    worst = worst_joint_rates(jacobian)
    twists = rng.normal(size=(500, 3))
    twists /= np.linalg.norm(twists, axis=1, keepdims=True)
    inverse = np.linalg.pinv(jacobian)
    assert (np.abs(twists @ inverse.T) <= worst * (1.0 + 1e-9)).all()
    hardest = inverse / np.linalg.norm(inverse, axis=1, keepdims=True)
    np.testing.assert_allclose((inverse * hardest).sum(axis=1), worst)
    assert worst.max() <= 1.0 / np.linalg.svd(jacobian, compute_uv=False)[-1] + 1e-9


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
