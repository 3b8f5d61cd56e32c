"""Taylor series in time: every function against Cauchy's integral, flows against exact solutions."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from safe_wrappers.control.estimation.taylor import output_series
from safe_wrappers.errors import ConfigurationError

ORDER = 8

FUNCTIONS = [  # name, function, where, radius in which it is analytic
    ("sin", np.sin, 0.7, 1.0),
    ("cos", np.cos, -2.0, 1.0),
    ("tan", np.tan, 0.4, 0.6),
    ("arcsin", np.arcsin, 0.3, 0.4),
    ("arccos", np.arccos, -0.3, 0.4),
    ("arctan", np.arctan, 0.5, 0.5),
    ("sinh", np.sinh, 1.2, 1.0),
    ("cosh", np.cosh, -0.4, 1.0),
    ("tanh", np.tanh, 0.6, 0.6),
    ("tanh of a negative", np.tanh, -0.6, 0.6),
    ("tanh at zero", np.tanh, 0.0, 0.6),
    ("exp", np.exp, -1.0, 1.0),
    ("log", np.log, 1.5, 0.7),
    ("sqrt", np.sqrt, 2.0, 1.0),
    ("square", np.square, 0.0, 1.0),
    ("reciprocal", lambda x: 2.0 / x, -1.3, 0.6),
    ("quotient", lambda x: (x + 1.0) / (3.0 - x), 0.4, 1.0),
    ("cube", lambda x: x**3 - 2.0 * x**0 + x**1, 0.0, 1.0),
    ("seventh power", lambda x: x**7, -0.9, 0.5),
    ("negative power", lambda x: x**-2, -0.9, 0.5),
    ("odd power", lambda x: x**2.3, 1.4, 0.6),
    ("power of a number", lambda x: 3.0**x, 0.2, 1.0),
    ("power of a series", lambda x: x**x, 1.4, 0.6),
]
REAL_ONLY = [  # the same, with an analytic function that it is near there
    ("hypotenuse", lambda x: np.hypot(x, 2.0), lambda x: np.sqrt(x * x + 4.0), 1.0, 0.8),
    ("absolute value", np.abs, lambda x: -x, -1.0, 0.5),
    ("angle to x", lambda x: np.arctan2(x, 2.0), lambda x: np.arctan(x / 2.0), 1.0, 0.8),
    ("angle to y", lambda x: np.arctan2(2 + 0 * x, x), lambda x: np.pi / 2 - np.arctan(x / 2.0), 1.0, 0.8),
    ("clip", lambda x: np.clip(x, -2.0, 2.0), lambda x: x, 1.0, 0.5),
    ("maximum", lambda x: np.maximum(x, 0.5), lambda x: x, 1.0, 0.5),
    ("minimum", lambda x: np.minimum(x, 0.5), lambda x: 0.0 * x + 0.5, 1.0, 0.5),
    ("norm", lambda x: np.linalg.norm(x * [3.0, 4.0]), lambda x: 5.0 * x, 1.0, 0.5),
    ("dot product", lambda x: np.dot([2.0, 1.0], np.array([x[0], 1.0])), lambda x: 2.0 * x + 1.0, 1.0, 0.5),
    (
        "cross product",
        lambda x: np.cross([x[0], 0.0, 0.0], [0.0, 0.0, -3.0])[1:2],
        lambda x: 3.0 * x,
        1.0,
        0.5,
    ),
]
CASES = [(name, function, function, at, radius) for name, function, at, radius in FUNCTIONS] + REAL_ONLY


def cauchy(function, at, radius, order):
    """Taylor coefficients of an analytic function by Cauchy's integral over a circle."""
    n = 256
    ring = radius * np.exp(2j * np.pi * np.arange(n) / n)
    values = function(at + ring)
    return (np.fft.fft(values) / n).real[: order + 1] / radius ** np.arange(order + 1)


@pytest.mark.parametrize(
    ("function", "analytic", "at", "radius"), [c[1:] for c in CASES], ids=[c[0] for c in CASES]
)
def test_a_functions_derivatives_are_those_of_cauchys_integral(function, analytic, at, radius):
    """With x' = 1 the coefficients in time are those in x, and their differential that of the next order."""
    found = output_series(lambda x: [1.0], lambda x: np.atleast_1d(function(x)), np.array([at]), ORDER)
    expected = cauchy(analytic, at, radius, ORDER + 1)[1:] * np.arange(1, ORDER + 2)
    np.testing.assert_allclose(found[:, 0, 0], expected, rtol=1e-9, atol=1e-8)


def test_in_two_variables_the_angle_and_the_length_are_those_of_the_logarithm():
    """log(x + iy) = log r + i angle, all around, also on the axes."""
    for turn in [*np.linspace(-3.0, 3.0, 13).tolist(), np.pi, np.pi / 2, -np.pi / 2]:
        point, push = 1.3 * np.exp(1j * turn), 0.3 - 0.8j
        found = output_series(
            lambda x, push=push: [push.real, push.imag],
            lambda x: [np.log(np.hypot(x[0], x[1])), np.arctan2(x[1], x[0])],
            np.array([point.real, point.imag]),
            5,
        )
        k = np.arange(6)
        by_point = (-push / point) ** k / point  # of d/dpoint log(point + push t), at t^k
        np.testing.assert_allclose(found[:, 0, 0], by_point.real, atol=1e-12)
        np.testing.assert_allclose(found[:, 0, 1], -by_point.imag, atol=1e-12)
        np.testing.assert_allclose(found[:, 1, 0], by_point.imag, atol=1e-12)
        np.testing.assert_allclose(found[:, 1, 1], by_point.real, atol=1e-12)


@settings(max_examples=25)
@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_a_linear_flow_is_the_matrix_exponential(n, seed):
    rng = np.random.default_rng(seed)
    a, c = rng.normal(size=(n, n)), rng.normal(size=(2, n))
    series = output_series(lambda x: a @ x, lambda x: c @ x, rng.normal(size=n), 30)
    t = 0.3
    summed = np.tensordot(t ** np.arange(31), series, axes=1)
    np.testing.assert_allclose(summed, c @ expm(a * t), atol=1e-10)


@pytest.mark.parametrize("at", [(3.0, 4.0), (-3.0, 4.0), (-4.0, -3.0), (0.1, -5.0)])
def test_what_is_made_of_an_angle_knows_its_quadrant(at):
    """cos(angle) = x / r, and the like through the other inverse functions."""
    x, y = at

    def h(z):
        near = 0.01 * z[0]
        angles = [np.cos(np.arctan2(z[1], z[0])), np.sin(np.arcsin(near)), np.cos(np.arccos(near))]
        return [*angles, np.tan(np.arctan(z[0])), np.exp(np.log(np.hypot(z[0], z[1])))]

    found = output_series(lambda z: [0.0, 0.0], h, np.array(at), 0)[0]
    r = np.hypot(x, y)
    expected = [[y * y / r**3, -x * y / r**3], [0.01, 0.0], [0.01, 0.0], [1.0, 0.0], [x / r, y / r]]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_nonlinear_flow_is_its_solution():
    """x' = -x³ has x = x0 / sqrt(1 + 2 x0² t), so dx/dx0 = (1 + 2 x0² t)^(-3/2)."""
    series = output_series(lambda x: [-(x[0] ** 3)], lambda x: [x[0]], np.array([0.8]), 40)
    t = 0.2
    assert t ** np.arange(41) @ series[:, 0, 0] == pytest.approx((1 + 2 * 0.64 * t) ** -1.5, abs=1e-12)


def test_a_sensitivity_agrees_with_torch():
    """Lie derivatives of a wheeled robot seen from a tilted mast, nested as they are defined."""
    torch = pytest.importorskip("torch")
    x0 = [0.4, -0.7, 0.9, 1.3]

    def rates(x, m, stack):
        return stack(
            [x[3] * m.cos(x[2]), x[3] * m.sin(x[2]), m.tanh(x[3] * x[0]), -0.3 * x[3] ** 2 + m.exp(x[1])]
        )

    def outputs(x, m, stack):
        return stack([m.sqrt(x[0] ** 2 + x[1] ** 2 + 0.5), m.sin(x[2]) / (x[3] + 2.0)])

    def lie(g):
        return lambda x: torch.func.jvp(g, (x,), (rates(x, torch, torch.stack),))[1]

    found = output_series(
        lambda x: rates(x, np, np.array), lambda x: outputs(x, np, np.array), np.array(x0), 5
    )
    g = lambda x: outputs(x, torch, torch.stack)  # noqa: E731
    for k in range(6):
        differential = torch.func.jacrev(g)(torch.tensor(x0, dtype=torch.float64)).numpy()
        np.testing.assert_allclose(found[k] * math.factorial(k), differential, rtol=1e-10, atol=1e-10)
        g = lie(g)


def test_branches_follow_the_initial_state():
    def h(x):
        if x[0] > 1.0 and x[0] >= 1.0 and not x[0] < 1.0 and not x[0] <= 1.0 and x[0] == 2.0 and x[0]:
            return [3.0 * x[0]]
        return [x[0]]

    assert output_series(lambda x: [0.0], h, np.array([2.0]), 1)[0, 0, 0] == 3.0
    assert output_series(lambda x: [0.0], h, np.array([0.5]), 1)[0, 0, 0] == 1.0


@pytest.mark.parametrize(
    ("f", "h", "words"),
    [
        (lambda x: [math.sin(x[0]), 0], lambda x: [x[0]], "f is run on Taylor series.*not `math`"),
        (lambda x: [0, 0], lambda x: [np.log2(x[0])], "h is run on Taylor series"),
        (lambda x: [0, 0], lambda x: [np.arctan2(2.0, x[0])], "first argument that varies"),
        (lambda x: [0, 0], lambda x: np.put(np.zeros(1), 0, x[0]), "h is run on Taylor series"),
        (lambda x: [0, 0], lambda x: x[0], r"h must return a list or an array of numbers, got shape \(\)"),
        (lambda x: [0], lambda x: [x[0]], "rate for each of the 2 states, got 1"),
        (lambda x: [0, 0], lambda x: [np.hypot(x[0], x[1])], "not differentiable"),
        (lambda x: [0, 0], lambda x: [abs(x[0])], "absolute value is not differentiable at zero"),
        (lambda x: [0, 0], lambda x: [np.log(x[0] - 1.0)], "logarithm of -1 does not exist"),
        (lambda x: [0, 0], lambda x: [(x[0] - 1.0) ** 0.5], "not differentiable at -1"),
        (lambda x: [0, np.nan], lambda x: [x[0]], "f or its derivatives are not finite"),
        (lambda x: [0, 0], lambda x: [x[0] * np.inf], "h or its derivatives are not finite"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_cannot_be_done_is_refused_with_the_reason(f, h, words):
    with pytest.raises(ConfigurationError, match=words):
        output_series(f, h, np.zeros(2), 3)
