"""Truncated Taylor series in time, with derivatives by the initial state: numbers that functions can be run on.

Evaluating f on them gives the solution of x' = f(x) as a Taylor series, and h on that the outputs, without step size
or differences: every coefficient is exact up to rounding. Functions may use + - * / ** @, comparisons,
`np.array([...])`, indexing, sums, and NumPy's sin, cos, tan, arcsin, arccos, arctan, arctan2, sinh, cosh, tanh, exp,
log, sqrt, square, hypot, abs, minimum, maximum, clip, dot, cross and linalg.norm. NumPy leaves hypot and arctan2 to
their first argument, which must not be a plain number: 2 + 0 * x, not 2. Where functions branch, the branch taken at
the initial state is followed.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

Function = Callable[[NDArray[Any]], ArrayLike]


def output_series(f: Function, h: Function, x: Array, order: int) -> Array:
    """Derivatives by x of the Taylor coefficients of h along the solution of x' = f(x) that starts in x.

    Args:
        f: Rates of the states, n of them.
        h: Outputs, m of them.
        x: Initial state, shape (n,).
        order: Of the last coefficient.

    Returns:
        Shape (order + 1, m, n): number k is the differential of the k-th Lie derivative of h along f, over k!.

    Raises:
        ConfigurationError: What f or h returns is not of the right size, not finite or not differentiable at x, or
            they do more than Taylor series can.
    """
    n = len(x)
    states = np.zeros((n, order + 1, n + 1))
    states[:, 0, 0] = x
    states[:, 0, 1:] = np.eye(n)
    for k in range(order):
        rates = _run("f", f, states[:, : k + 1])
        if len(rates) != n:
            raise ConfigurationError(f"f must return a rate for each of the {n} states, got {len(rates)}")
        states[:, k + 1] = rates[:, k] / (k + 1)
    outputs = _run("h", h, states)
    return np.asarray(outputs[:, :, 1:].swapaxes(0, 1))


def _run(name: str, function: Function, states: Array) -> Array:
    """Coefficients of what the function returns for the states, shape (outputs, orders, n + 1)."""
    given = np.empty(len(states), dtype=object)
    given[:] = [Series(coefficients) for coefficients in states]
    try:
        returned = np.asarray(function(given), dtype=object)
        if returned.ndim != 1:
            raise ConfigurationError(
                f"{name} must return a list or an array of numbers, got shape {returned.shape}"
            )
        found = np.array([given[0]._lifted(value) for value in returned]).reshape(-1, *states.shape[1:])
    except (TypeError, AttributeError) as error:
        raise ConfigurationError(
            f"{name} is run on Taylor series, and this failed: {error}. It may use arithmetic and NumPy's elementary "
            "functions (see safe_wrappers.control.estimation.taylor), not `math`, must build its result by "
            "`np.array([...])` and give hypot and arctan2 a first argument that varies (2 + 0 * x for 2)"
        ) from error
    if not np.isfinite(found).all():
        raise ConfigurationError(f"{name} or its derivatives are not finite at {states[:, 0, 0].tolist()}")
    return found


class Series:
    """A number that varies with time, c[0] + c[1] t + ..., each coefficient with its derivatives.

    Args:
        coefficients: Shape (orders, 1 + n): the coefficient and its n derivatives.
    """

    __slots__ = ("c",)

    def __init__(self, coefficients: Array) -> None:
        self.c = coefficients

    def _lifted(self, other: object) -> Array:
        """The other's coefficients, of as many orders as these."""
        if isinstance(other, Series):
            return other.c
        constant = np.zeros_like(self.c)
        constant[0, 0] = float(other)  # type: ignore[arg-type]
        return constant

    def __add__(self, other: object) -> "Series":
        return NotImplemented if isinstance(other, np.ndarray) else Series(self.c + self._lifted(other))

    def __sub__(self, other: object) -> "Series":
        return NotImplemented if isinstance(other, np.ndarray) else Series(self.c - self._lifted(other))

    def __mul__(self, other: object) -> "Series":
        if isinstance(other, np.ndarray):
            return NotImplemented
        b = self._lifted(other)
        product = _times(self.c[:, 0]) @ b
        product[:, 1:] += _times(b[:, 0]) @ self.c[:, 1:]
        return Series(product)

    __radd__ = __add__
    __rmul__ = __mul__

    def __rsub__(self, other: object) -> "Series":
        return -self + other

    def __neg__(self) -> "Series":
        return Series(-self.c)

    def __pos__(self) -> "Series":
        return self

    def __abs__(self) -> "Series":
        if self.c[0, 0] == 0.0:
            raise ConfigurationError("the absolute value is not differentiable at zero")
        return -self if self.c[0, 0] < 0.0 else self

    def __truediv__(self, other: object) -> "Series":
        return (
            NotImplemented
            if isinstance(other, np.ndarray)
            else self * Series(self._lifted(other))._power(-1.0)
        )

    def __rtruediv__(self, other: object) -> "Series":
        return self._power(-1.0) * other

    def __pow__(self, exponent: object) -> "Series":
        if isinstance(exponent, np.ndarray):
            return NotImplemented
        if isinstance(exponent, Series):
            return (exponent * self.log()).exp()
        p = float(exponent)  # type: ignore[arg-type]
        if p < 0.0 or not p.is_integer():
            return self._power(p)
        if p == 0.0:
            return Series(self._lifted(1.0))
        half = self ** (p // 2)
        return half * half * self if p % 2 else half * half

    def __rpow__(self, base: object) -> "Series":
        return (math.log(float(base)) * self).exp()  # type: ignore[arg-type]

    def __float__(self) -> float:
        raise TypeError("a Taylor series is not one number")

    def __bool__(self) -> bool:
        return bool(self.c[0, 0])

    def __eq__(self, other: object) -> bool:
        return bool(self.c[0, 0] == self._lifted(other)[0, 0])

    __hash__ = None  # type: ignore[assignment]

    def __lt__(self, other: object) -> bool:
        return bool(self.c[0, 0] < self._lifted(other)[0, 0])

    def __le__(self, other: object) -> bool:
        return bool(self.c[0, 0] <= self._lifted(other)[0, 0])

    def __gt__(self, other: object) -> bool:
        return bool(self.c[0, 0] > self._lifted(other)[0, 0])

    def __ge__(self, other: object) -> bool:
        return bool(self.c[0, 0] >= self._lifted(other)[0, 0])

    def _through(self, value: float, slope: Array) -> "Series":
        """A function of this whose value at time zero is given, and whose slope, as a series, too."""
        chained = _times(slope) @ self.c
        k = np.arange(1, len(self.c))
        rates = (_times(slope) @ _derivative(self.c[:, 0]))[:-1]
        chained[1:, 0] = rates / k
        chained[0, 0] = value
        return Series(chained)

    def _power(self, p: float) -> "Series":
        a = self.c[:, 0]
        if a[0] == 0.0 or (a[0] < 0.0 and not p.is_integer()):
            raise ConfigurationError(f"to the power of {p:g} is not differentiable at {a[0]:g}")
        return self._through(float(a[0] ** p), p * _power_series(a, p - 1.0))

    def sqrt(self) -> "Series":
        """Square root; not at zero, where it has no derivative."""
        return self._power(0.5)

    def exp(self) -> "Series":
        """Exponential."""
        e = _exponential(self.c[:, 0])
        return self._through(e[0], e)

    def log(self) -> "Series":
        """Natural logarithm."""
        if self.c[0, 0] <= 0.0:
            raise ConfigurationError(f"the logarithm of {self.c[0, 0]:g} does not exist")
        return self._through(math.log(self.c[0, 0]), _power_series(self.c[:, 0], -1.0))

    def sin(self) -> "Series":
        """Sine."""
        wave = _exponential(1j * self.c[:, 0])
        return self._through(wave[0].imag, wave.real)

    def cos(self) -> "Series":
        """Cosine."""
        wave = _exponential(1j * self.c[:, 0])
        return self._through(wave[0].real, -wave.imag)

    def tan(self) -> "Series":
        """Tangent."""
        return self.sin() / self.cos()

    def sinh(self) -> "Series":
        """Hyperbolic sine."""
        return 0.5 * (self.exp() - (-self).exp())

    def cosh(self) -> "Series":
        """Hyperbolic cosine."""
        return 0.5 * (self.exp() + (-self).exp())

    def tanh(self) -> "Series":
        """Hyperbolic tangent."""
        negative = self.c[0, 0] < 0.0  # the exponential of a large positive number would overflow
        shrunk = (2.0 * self if negative else -2.0 * self).exp()
        size = (1.0 - shrunk) / (1.0 + shrunk)
        return -size if negative else size

    def arctan(self) -> "Series":
        """Inverse tangent."""
        slope = (1.0 + self * self)._power(-1.0)
        return self._through(math.atan(self.c[0, 0]), slope.c[:, 0])

    def arcsin(self) -> "Series":
        """Inverse sine."""
        slope = (1.0 - self * self)._power(-0.5)
        return self._through(math.asin(self.c[0, 0]), slope.c[:, 0])

    def arccos(self) -> "Series":
        """Inverse cosine."""
        return 0.5 * math.pi - self.arcsin()

    def hypot(self, other: object) -> "Series":
        """Length of the vector (this, other); not at zero, where it has no derivative."""
        return (self * self + Series(self._lifted(other)) ** 2).sqrt()

    def arctan2(self, other: object) -> "Series":
        """Of a point's y (this) and x: from the nearer axis, so that nothing is divided by zero off the origin."""
        x = Series(self._lifted(other))
        angle = math.atan2(self.c[0, 0], x.c[0, 0])
        turned = (self / x).arctan() if abs(x.c[0, 0]) >= abs(self.c[0, 0]) else -(x / self).arctan()
        turned.c[0, 0] = angle
        return turned


def _times(a: NDArray[Any]) -> NDArray[Any]:
    """The matrix by which a series multiplies another one: lower triangular, constant along its diagonals."""
    k = np.arange(len(a))
    return np.asarray(np.where(k[:, None] >= k, a[k[:, None] - k], 0.0))


def _derivative(a: NDArray[Any]) -> NDArray[Any]:
    """By time; the last order, unknown, is zero."""
    return np.append(a[1:] * np.arange(1, len(a)), 0.0)


def _exponential(a: NDArray[Any]) -> NDArray[Any]:
    """From e' = a' e."""
    e = np.zeros_like(a)
    e[0] = np.exp(a[0])
    rate = _derivative(a)
    for k in range(1, len(a)):
        e[k] = rate[:k] @ e[k - 1 :: -1] / k
    return e


def _power_series(a: Array, p: float) -> Array:
    """From a b' = p a' b; a[0] is not zero."""
    b = np.zeros_like(a)
    b[0] = a[0] ** p
    for k in range(1, len(a)):
        j = np.arange(1, k + 1)
        b[k] = ((p * j - (k - j)) * a[1 : k + 1]) @ b[k - 1 :: -1] / (k * a[0])
    return b
