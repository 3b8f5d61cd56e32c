"""Lie derivatives and relative degree: against differences and textbook systems."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.filtering.cbf import (
    cbf_rows,
    lie_derivatives,
    numerical_gradient,
    relative_degree,
)


def f(x):
    return np.array([x[1], -np.sin(x[0]) - 0.1 * x[1], x[0] * x[2]])


def g(x):
    return np.array([[0.0, 0.0], [1.0 + x[0] ** 2, 0.2], [0.0, np.cos(x[2])]])


def h(x):
    return 2.0 - x[0] ** 2 - x[0] * x[1] - 0.5 * x[1] ** 2 + np.sin(x[2])


def gradient(x):
    return np.array([-2 * x[0] - x[1], -x[0] - x[1], np.cos(x[2])])


@pytest.mark.parametrize("seed", range(5))
def test_lie_derivatives_are_the_rate_of_h(seed):
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=3), rng.normal(size=2)
    drift, effect = lie_derivatives(gradient(x), f(x), g(x))
    step = 1e-6
    velocity = f(x) + g(x) @ u
    expected = (h(x + step * velocity) - h(x - step * velocity)) / (2 * step)
    assert drift + effect @ u == pytest.approx(expected, abs=1e-7)
    assert effect.shape == (2,) and np.shape(drift) == ()


def test_batches_of_any_shape():
    rng = np.random.default_rng(0)
    dh, fs, gs = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5, 3, 2))
    drift, effect = lie_derivatives(dh, fs, gs)
    assert drift.shape == (4, 5) and effect.shape == (4, 5, 2)
    one, row = lie_derivatives(dh[1, 2], fs[1, 2], gs[1, 2])
    assert drift[1, 2] == pytest.approx(one)
    np.testing.assert_allclose(effect[1, 2], row)
    normals, offsets = cbf_rows(drift, effect, 2.0 * drift)
    assert normals.shape == (4, 5, 2) and offsets.shape == (4, 5)


@given(st.integers(0, 1000))
def test_rows_say_the_same_as_the_condition(seed):
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=3), rng.normal(size=2)
    drift, effect = lie_derivatives(gradient(x), f(x), g(x))
    normals, offsets = cbf_rows(drift, effect, 1.5 * h(x))
    left = drift + effect @ u + 1.5 * h(x)
    assert offsets - normals @ u == pytest.approx(left, abs=1e-12)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_numerical_gradient(scale):
    x = scale * np.array([0.3, -0.7, 1.2])
    np.testing.assert_allclose(
        numerical_gradient(lambda y: h(y / scale), x),
        gradient(x / scale) / scale,
        rtol=1e-5,
        atol=1e-8 / scale,
    )


def chain(order):
    """x1' = x2, ..., xn' = u."""
    shift = np.eye(order, k=1)
    last = np.eye(order)[:, -1:]
    return (lambda x: shift @ x), (lambda x: last)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("nonlinear", [False, True])
def test_relative_degree_of_integrator_chains(order, nonlinear):
    drift, effect = chain(order)
    barrier = (lambda x: 2.0 - x[0] - 0.3 * x[0] ** 2) if nonlinear else (lambda x: 2.0 - x[0])
    for x in (np.full(order, 0.4), np.linspace(-0.5, 1.0, order)):
        assert relative_degree(barrier, drift, effect, x) == order
    assert relative_degree(lambda x: 1.0 - x[-1], drift, effect, np.full(order, 0.4)) == 1


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_relative_degree_does_not_depend_on_the_size_of_g(size):
    drift, effect = chain(2)
    scaled = lambda x: size * effect(x)  # noqa: E731
    assert relative_degree(lambda x: 1.0 - x[0], drift, scaled, [0.3, 0.2]) == 2
    assert relative_degree(lambda x: 1.0 - x[1], drift, scaled, [0.3, 0.2]) == 1


@pytest.mark.parametrize("scale", [1e-12, 1e-9, 1e-3, 1e3, 1e9, 1e12])
@pytest.mark.parametrize("of_control", [1e-9, 1.0, 1e9])
def test_relative_degree_does_not_depend_on_the_units_of_h_and_of_the_control(scale, of_control):
    for order in (1, 2, 3):
        drift, effect = chain(order)
        # A second control acts on nothing.
        both = lambda x, effect=effect: np.hstack([effect(x) * of_control, 0.0 * effect(x)])  # noqa: E731
        barrier = lambda x: scale * (2.0 - x[0] - 0.3 * x[0] ** 2)  # noqa: E731
        assert relative_degree(barrier, drift, both, np.full(order, 0.4)) == order
    drift, effect = lambda x: np.array([-x[0], x[1]]), lambda x: np.array([[0.0], [of_control]])
    assert relative_degree(lambda x: scale * (1.0 - x[0]), drift, effect, [0.3, 0.2]) is None
    assert relative_degree(lambda x: scale * np.cos(x[0]), drift, effect, [0.3, 0.2]) is None
    assert relative_degree(lambda x: scale, drift, effect, [0.3, 0.2]) is None


def test_a_weak_control_beside_a_strong_one_counts():
    drift = lambda x: np.zeros(2)  # noqa: E731
    effect = lambda x: np.diag([1e6, 1e-6])  # noqa: E731
    assert relative_degree(lambda x: 1.0 - x[1], drift, effect, [0.3, 0.2]) == 1


def test_an_uncontrollable_state_has_none():
    drift = lambda x: np.array([-x[0], x[1]])  # noqa: E731
    effect = lambda x: np.array([[0.0], [1.0]])  # noqa: E731
    assert relative_degree(lambda x: 1.0 - x[0], drift, effect, [0.3, 0.2]) is None
    assert relative_degree(lambda x: 1.0, drift, effect, [0.3, 0.2]) is None
    assert relative_degree(lambda x: 1.0 - x[0], *chain(3), [0.1, 0.2, 0.3], max_degree=2) is None


def test_the_kinetic_inset_has_relative_degree_one():
    drift, effect = chain(2)
    assert relative_degree(lambda x: 3.0 - x[0] - x[1] ** 2 / 2.0, drift, effect, [0.3, 0.8]) == 1
