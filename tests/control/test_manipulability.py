"""Manipulability against SVD and exact determinants; its gradient by differences, validated thresholds."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safe_wrappers.control.filtering.manipulability import (
    chain_derivative,
    manipulability,
    manipulability_gradient,
    task_rows,
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


def test_near_rank_loss_it_is_exact_where_the_determinant_is_not():
    rng = np.random.default_rng(0)
    worse = 0
    for small in (1e-3, 1e-6, 1e-9, 1e-11):
        for _ in range(20):
            u, v = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.linalg.qr(rng.normal(size=(6, 6)))[0]
            jacobian = (u * [1.0, 0.5, small]) @ v[:3]
            truth = exact(jacobian)
            assert manipulability(jacobian) == pytest.approx(truth, rel=50 * 2.3e-16 / small)
            naive = np.linalg.det(jacobian @ jacobian.T)
            worse += not naive > 0.0 or abs(np.sqrt(naive) / truth - 1.0) > 1e-2
    assert worse >= 40  # every matrix at 1e-9 and 1e-11: wrong, or the root of a negative number


@pytest.mark.parametrize(
    "jacobian",
    [
        np.zeros((2, 4)),
        [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]],
        [[1.0, 0.1, 0.3], [0.7, 0.3, 0.2], [1.7, 0.4, 0.5]],  # the third row is the sum of the others
        [[0.0, 0.0], [1.0, 1.0]],
    ],
)
def test_it_is_zero_at_rank_loss(jacobian):
    assert manipulability(jacobian) == 0.0
    assert np.isinf(worst_joint_rates(jacobian)).all()


def test_rows_of_different_units_do_not_look_dependent():
    assert manipulability(np.diag([1.0, 1e-30])) == pytest.approx(1e-30)


def test_with_fewer_joints_than_directions_it_is_zero_everywhere():
    tall = np.random.default_rng(0).normal(size=(5, 3, 2))
    assert (manipulability(tall) == 0.0).all() and manipulability(tall).shape == (5,)


def test_leading_axes_are_a_batch():
    batch = np.random.default_rng(0).normal(size=(2, 5, 3, 7))
    w, rates = manipulability(batch), worst_joint_rates(batch)
    for i in np.ndindex(2, 5):
        assert w[i] == manipulability(batch[i])
        np.testing.assert_array_equal(rates[i], worst_joint_rates(batch[i]))


# The ellipsoid, and what joint rates a twist takes ------------------------------------------------------------


def test_a_two_link_arm_in_closed_form():
    a, b = 0.1, 0.11
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2))
    s1, c1 = np.sin(q[:, 0]), np.cos(q[:, 0])
    s12, c12 = np.sin(q.sum(1)), np.cos(q.sum(1))
    jacobian = np.array([[-a * s1 - b * s12, -b * s12], [a * c1 + b * c12, b * c12]]).transpose(2, 0, 1)
    np.testing.assert_allclose(manipulability(jacobian), a * b * np.abs(np.sin(q[:, 1])), rtol=1e-11)


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


def test_w_does_not_bound_the_joint_rates():
    round_, thin = np.diag([1.0, 1.0]), np.diag([1e3, 1e-3])
    assert manipulability(round_) == pytest.approx(manipulability(thin))
    assert worst_joint_rates(thin).max() == pytest.approx(1e3 * worst_joint_rates(round_).max())


# Gradient -----------------------------------------------------------------------------------------------------


def chain(q, axes, anchors, slides):
    """Six-row Jacobian of a chain written down by hand: axes and anchors turn with the joints before them."""
    rotation, place, columns = np.eye(3), np.zeros(3), []
    for angle, axis, anchor, slide in zip(q, axes, anchors, slides, strict=True):
        place = place + rotation @ anchor
        world = rotation @ axis
        columns.append((world, place.copy(), slide))
        if slide:
            place = place + angle * world
        else:
            k = np.cross(np.eye(3), axis)
            rotation = rotation @ (np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k)
    tip = place + rotation @ np.array([0.3, 0.1, -0.2])
    linear = [w if s else np.cross(w, tip - p) for w, p, s in columns]
    angular = [np.zeros(3) if s else w for w, p, s in columns]
    return np.concatenate([np.array(linear).T, np.array(angular).T])


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_a_chain_s_derivative_and_the_gradient_are_their_differences(seed, n):
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    made = (axes, rng.normal(size=(n, 3)), rng.random(n) < 0.3)
    q, step = rng.uniform(-2.0, 2.0, n), 1e-6

    def difference(f):
        return np.array([(f(q + step * e) - f(q - step * e)) / (2.0 * step) for e in np.eye(n)])

    jacobian = chain(q, *made)
    derivative = chain_derivative(jacobian[:3], jacobian[3:])
    np.testing.assert_allclose(derivative, difference(lambda x: chain(x, *made)), atol=1e-7)

    def of_task(six, directions, rotations, length=None):
        rows, scale = task_rows(directions, rotations, length)
        return six[..., rows, :] * scale[:, None]

    for task in (("x", ""), ("xz", ""), ("xyz", ""), ("", "zy"), ("xy", "z", 0.2)):
        rows = of_task(jacobian, *task)
        if rows.shape[0] > n or manipulability(rows) < 1e-3:
            continue
        slope = manipulability_gradient(rows, of_task(derivative, *task))
        wanted = difference(lambda x, task=task: manipulability(of_task(chain(x, *made), *task)))
        np.testing.assert_allclose(slope, wanted, atol=1e-6 * max(1.0, np.abs(wanted).max()))


def test_the_gradient_stays_a_number_where_w_is_zero():
    # Two links, stretched: w = |sin q2|, slope 1 to one side and -1 to the other.
    jacobian = np.array([[0.0, 0.0], [2.0, 1.0]])
    derivative = np.array([[[-2.0, -1.0], [0.0, 0.0]], [[-1.0, -1.0], [0.0, 0.0]]])
    slope = manipulability_gradient(jacobian, derivative)
    assert slope[0] == pytest.approx(0.0, abs=1e-12) and abs(slope[1]) == pytest.approx(1.0)


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
    assert found.samples == 200 and found.exceeding == (need > limit).sum()
    above = w > found.threshold * (1.0 + 1e-9)  # its w is of another factorisation
    assert (need[above] <= limit).all() and found.above == above.sum()
    if found.exceeding:
        assert (need[w > found.threshold * (1.0 - 1e-9)] > limit).any()
    else:
        assert found.threshold == pytest.approx(w.min())
    twice = validated_threshold(samples, 0.5, limit / 2.0)
    assert twice.threshold == found.threshold


def test_limits_of_the_joints_count_one_by_one():
    samples = np.array([np.diag([1.0, 0.5]), np.diag([0.5, 1.0]), np.diag([1.0, 0.9])])
    assert validated_threshold(samples, 1.0, [1.5, 3.0]).exceeding == 1
    assert validated_threshold(samples, 1.0, [3.0, 3.0]).exceeding == 0


def test_what_a_sample_leaves_unseen_is_seen_as_often_as_it_says():
    # Two joints, w uniform in (0, 1): all below 0.3 exceed. What is missed is the mass between threshold and 0.3.
    rng, missed = np.random.default_rng(0), 0
    for _ in range(400):
        w = rng.random(60)
        samples = np.array([np.diag([1.0, v]) for v in w])
        found = validated_threshold(samples, 1.0, 1.0 / 0.3)
        missed += 0.3 - found.threshold > found.unseen(0.9)
    assert 0.05 < missed / 400 < 0.14  # a tenth, by the binomial's spread
    assert found.unseen(0.95) == pytest.approx(1.0 - 0.05 ** (1.0 / 60.0))
    with pytest.raises(ConfigurationError, match="confidence is between 0 and 1"):
        found.unseen(1.0)


# Nonsense -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: manipulability([1.0, 2.0]),
            r"a Jacobian has the shape \(..., directions, joints\), got \(2,\)",
        ),
        (lambda: manipulability(np.zeros((0, 3))), "a Jacobian has the shape"),
        (lambda: manipulability([[np.nan, 1.0]]), "jacobian must be finite"),
        (lambda: manipulability("no"), "jacobian is a number or an array of numbers"),
        (
            lambda: manipulability_gradient(np.ones((2, 3)), np.ones((3, 2, 2))),
            r"has the shape \(..., k, 2, 3\)",
        ),
        (lambda: manipulability_gradient(np.ones((3, 2)), np.ones((2, 3, 2))), "w is zero everywhere"),
        (lambda: chain_derivative(np.ones((2, 4)), np.ones((2, 4))), r"have the shape \(..., 3, n\)"),
        (lambda: task_rows("xw", "", None), 'directions is some of "xyz", each once'),
        (lambda: task_rows("xx", "", None), 'directions is some of "xyz", each once'),
        (lambda: task_rows("", ["x"], None), 'rotations is some of "xyz"'),
        (lambda: task_rows("", "", None), "got neither"),
        (lambda: task_rows("xyz", "z", None), r"give the length \(m\) by which a rotation counts"),
        (lambda: task_rows("xyz", "", 0.1), "this task has one of them only"),
        (lambda: task_rows("xyz", "z", -0.1), "length must be a finite number > 0"),
        (
            lambda: validated_threshold(np.ones((2, 3)), 1.0, 1.0),
            r"jacobians has the shape \(samples, m, n\)",
        ),
        (lambda: validated_threshold(np.ones((4, 2, 3)), 0.0, 1.0), "task_speed and rate_limit are > 0"),
        (lambda: validated_threshold(np.ones((4, 2, 3)), 1.0, [1.0, 1.0]), "one limit or 3 of them"),
    ],
)
def test_nonsense_is_refused(call, message):
    with pytest.raises(ConfigurationError, match=message):
        call()
