"""Lie derivatives and relative degree: against differences and textbook systems."""

import numpy as np
import pytest

from safe_wrappers.control.barriers import (
    numerical_gradient,
    relative_degree,
)


def h(x):
    return 2.0 - x[0] ** 2 - x[0] * x[1] - 0.5 * x[1] ** 2 + np.sin(x[2])


def gradient(x):
    return np.array([-2 * x[0] - x[1], -x[0] - x[1], np.cos(x[2])])


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
