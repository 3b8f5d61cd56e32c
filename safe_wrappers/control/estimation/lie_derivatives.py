"""Observability of nonlinear systems, at one state, by the rank of the Lie derivatives of their outputs.

`safe_wrappers.control.estimation.observability` finds the unobservable directions of linear systems.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.observability import (
    LONGEST_TIME_SCALE_S,
    TOLERANCE,
    checked_vector,
    described_subspace,
    state_names,
)
from safe_wrappers.control.estimation.taylor import Function, output_series
from safe_wrappers.errors import ConfigurationError

_STATE_ROUNDING = 1e-12
"""Relative; what this much of an error in the state can make of a coefficient is not told from zero."""
_NOISE_FACTOR = 10.0
_PROBES = 4
_LARGEST_COLUMN_SCALE = 1e3


@dataclass(frozen=True, eq=False)
class NonlinearObservability:
    """Which directions of a state the outputs determine, locally.

    Attributes:
        rank: Number of independent observable directions.
        singular_values: Of the scaled observability matrix, largest first, shape (n,).
        gap: Factor by which the tolerance could be larger, or smaller, without a change of rank. Below about 10 the
            rank depends on the choice of tolerance.
        unobservable: Orthonormal basis of the unobservable directions, shape (n, n - rank).
        names: The same subspace as readable combinations of the states, one for each direction.
        rank_by_order: Rank with Lie derivatives up to order 0, 1, ...: shows whether it had stopped growing.
    """

    rank: int
    singular_values: Array
    gap: float
    unobservable: Array
    names: tuple[str, ...]
    rank_by_order: tuple[int, ...]

    @property
    def observable(self) -> bool:
        """Whether the rank is full."""
        return not self.names

    @property
    def condition(self) -> float:
        """Largest singular value over the smallest nonzero one, after scaling; infinite for rank 0.

        A large one says that some direction shows weakly in the outputs, or late.
        """
        smallest = self.singular_values[self.rank - 1] if self.rank else 0.0
        return float(self.singular_values[0] / smallest) if smallest > 0.0 else math.inf


def nonlinear_observability(
    f: Function,
    h: Function,
    x: ArrayLike,
    names: Sequence[str] | None = None,
    order: int | None = None,
    tolerance: float | None = None,
) -> NonlinearObservability:
    """Local observability of x' = f(x) from the outputs h(x), near x.

    The rows are the differentials of the Lie derivatives of h along f at x (Hermann and Krener 1977). They are the
    Taylor coefficients, in time, of the output's sensitivity to the initial state, and are found by running f and h
    on truncated Taylor series (`taylor.output_series`), without differences or step size: they are exact up to
    rounding, and values that a relative error of 1e-12 in x could make of zero count as zero. Each output's rows are
    scaled by the time on which that output changes, and each state's column by its size (by a factor of up to a
    thousand), so that the result does not depend on units.

    Known inputs belong into f: close over them. An input that varies is an extra state that is measured.

    Full rank is sufficient for states *near* x to be told apart, under the usual regularity; far ones may still give
    the same outputs, and nothing is said about accuracy. Lower rank is no proof that they cannot: at special states
    Lie derivatives beyond any given order may add to it, and n - 1 are not always enough. So the rank is not given up
    when it stalls: all orders up to `order` are taken, and `rank_by_order` shows them.

    Args:
        f: Rates of the states: takes an array of shape (n,), returns n numbers. Written with NumPy's functions
            (`safe_wrappers.control.estimation.taylor` lists them), not with `math`.
        h: Outputs: takes the same, returns m numbers. Also written with NumPy's functions.
        x: The state, shape (n,).
        names: Of the n states; x0, x1, ... if not given.
        order: Highest Lie derivative; 2 n if not given.
        tolerance: Singular values up to this share of the largest count as zero; `TOLERANCE` if not given.

    Raises:
        ConfigurationError: What f and h return does not fit x, cannot be run on Taylor series, or is not finite at x;
            names that are not one for each state; a negative order.

    >>> def distance(x):
    ...     return [np.hypot(x[0], x[1])]  # to a beacon at the origin
    >>> nonlinear_observability(lambda x: [0, 0], distance, [3, 4], names=("x", "y")).names  # at rest
    ('x - 0.75 y',)
    >>> nonlinear_observability(lambda x: [1, 0], distance, [3, 4], names=("x", "y")).observable  # it moves
    True

    Moving along the line to the beacon would not help; and what moves on a straight line cannot tell its own side of
    the beacon from the mirrored one, which is not near.
    """
    state = checked_vector(x)
    known = state_names(names, len(state))
    if order is not None and order < 0:
        raise ConfigurationError(f"the order of the Lie derivatives must not be negative, got {order}")
    tolerance = checked_tolerance(tolerance)
    series = _certain_series(f, h, state, 2 * len(state) if order is None else order)
    rows = np.stack([_in_own_time(output) for output in series.swapaxes(0, 1)], axis=1)
    sizes = np.abs(rows).max(axis=(0, 1))
    units = (
        1.0 / np.maximum(sizes, sizes.max() / _LARGEST_COLUMN_SCALE) if sizes.any() else np.ones_like(sizes)
    )
    rows = rows * units
    by_order = [rows[: k + 1].reshape(-1, len(state)) for k in range(len(rows))]
    ranks = tuple(_count(np.linalg.svd(m, compute_uv=False), tolerance) for m in by_order)
    _, values, axes = np.linalg.svd(by_order[-1])
    basis, _ = np.linalg.qr(units[:, None] * axes[ranks[-1] :].T)
    values = padded(values, len(state))
    return NonlinearObservability(
        rank=ranks[-1],
        singular_values=values,
        gap=tolerance_gap(values / (values[0] or 1.0), tolerance),
        unobservable=basis,
        names=described_subspace(basis, known),
        rank_by_order=ranks,
    )


def padded(values: NDArray[np.floating[Any]], n: int) -> Array:
    """The first n values, zeros where there are fewer, shape (n,)."""
    result = np.zeros(n)
    result[: len(values)] = values[:n]
    return result


def _certain_series(f: Function, h: Function, x: Array, order: int) -> Array:
    """The output's differentials, with zeros for what is no larger than the state's rounding makes it.

    A value that should vanish, such as the sine of pi, comes out as 1e-16; scaled by itself it would count.
    """
    series = output_series(f, h, x, order)
    rng = np.random.default_rng(0)
    noise = np.zeros_like(series)
    for _ in range(_PROBES):
        probe = output_series(f, h, x * (1.0 + _STATE_ROUNDING * rng.choice([-1.0, 1.0], len(x))), order)
        noise = np.maximum(noise, np.abs(probe - series))
    return np.where(np.abs(series) > _NOISE_FACTOR * noise, series, 0.0)


def _in_own_time(rows: Array) -> Array:
    """Rows of one output, order by order, in the time on which it changes, the longest row of length one.

    That time is the usual ratio of one order to the next. A root of the last order over the first would make the time
    longer, the weaker what the first order misses, and so hide how weak it is.
    """
    lengths = np.linalg.norm(rows, axis=1)
    orders = np.flatnonzero(lengths)
    if not orders.size:
        return rows
    growth = np.diff(np.log(lengths[orders])) / np.diff(orders)
    rate = max(math.exp(np.median(growth)) if growth.size else 0.0, 1.0 / LONGEST_TIME_SCALE_S)
    scaled = rows / rate ** np.arange(len(rows))[:, None]
    return np.asarray(scaled / np.linalg.norm(scaled, axis=1).max())


def _count(values: Array, tolerance: float) -> int:
    return int((values > tolerance * values[0]).sum()) if values.size and values[0] > 0.0 else 0


def checked_tolerance(tolerance: float | None) -> float:
    """The tolerance, between 0 and 1, or `TOLERANCE` for None."""
    if tolerance is None:
        return TOLERANCE
    if not 0.0 < tolerance < 1.0:
        raise ConfigurationError(f"the tolerance is a share of the scale, between 0 and 1, got {tolerance}")
    return tolerance


def tolerance_gap(values: Array, tolerance: float) -> float:
    """Factor by which the tolerance could be larger or smaller with the same number of values above it."""
    kept, dropped = values[values > tolerance], values[values <= tolerance]
    largest = dropped.max(initial=0.0)
    below = tolerance / largest if largest > 0.0 else math.inf
    return float(min(kept.min(initial=math.inf) / tolerance, below))
