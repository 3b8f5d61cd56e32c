"""Observability: which parts of a state a sensor can tell at all, named in the user's own state names.

A direction in which two states give the same outputs for ever is one that no filter resolves: what was not known
there at the start develops as if nothing were ever measured. What is said here is structural: about ideal outputs,
without noise. Full rank says that the state can be told, near this state if the system is nonlinear; it says nothing
about how accurately or how soon, and `condition` only hints at it. A direction that is missing needs another sensor,
a motion that has a permission of its own, or a restricted task.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.numerics.finite import finite_arrays
from safe_wrappers.control.numerics.taylor import Function, output_series
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]

TOLERANCE: Final = 1e-9
"""Singular values below this share of the scale count as zero unless the caller says otherwise."""

LONGEST_TIME_SCALE_S: Final = 1e6
"""s; what changes more slowly than this is judged on this scale, or rounding errors would pass for slow motion."""

_NO_COUPLING = 1e-13
"""Entries of A or C below this share of its largest are rounding."""
_STATE_ROUNDING = 1e-12
"""Relative; what this much of an error in the state can make of a coefficient is not told from zero."""
_NOISE_FACTOR = 10.0
_PROBES = 4
_LARGEST_COLUMN_SCALE = 1e3
_NEGLIGIBLE = 1e-8
_PIVOT = 0.1


@dataclass(frozen=True, eq=False)
class Observability:
    """What can be told of a state, and what cannot.

    Attributes:
        rank: Number of independent directions that can be told.
        singular_values: Of the scaled observability matrix, largest first, shape (n,).
        gap: Factor by which the tolerance could be larger, or smaller, and the rank still the same. Below about 10
            the rank is a matter of opinion: it hangs on the tolerance.
        unobservable: Orthonormal basis of the directions that cannot be told, shape (n, n - rank).
        names: The same subspace as readable combinations of the states, one for each direction: where it is spanned
            by single states, these.
    """

    rank: int
    singular_values: Array
    gap: float
    unobservable: Array
    names: tuple[str, ...]

    @property
    def observable(self) -> bool:
        """Whether every direction can be told: full rank."""
        return not self.names

    @property
    def condition(self) -> float:
        """Largest singular value over the smallest that counts; infinite where nothing can be told.

        A large one says that some direction hardly shows in the outputs, or late; after scaling, units apart.
        """
        smallest = self.singular_values[self.rank - 1] if self.rank else 0.0
        return float(self.singular_values[0] / smallest) if smallest > 0.0 else math.inf


@dataclass(frozen=True, eq=False)
class LinearObservability(Observability):
    """Observability of x' = A x, y = C x: of every state at once, over any time however short.

    Attributes:
        time_scale_s: Time by which A was multiplied to be free of units, s.
        unobservable_modes: Eigenvalues of A on the unobservable directions, 1/s, shape (n - rank,): an error there
            decays by itself if their real parts are negative.
    """

    time_scale_s: float
    unobservable_modes: NDArray[np.complex128]

    @property
    def detectable(self) -> bool:
        """Whether what cannot be told decays by itself."""
        return bool((self.unobservable_modes.real < 0.0).all())


@dataclass(frozen=True, eq=False)
class NonlinearObservability(Observability):
    """Local observability at one state.

    Attributes:
        rank_by_order: Rank with Lie derivatives up to order 0, 1, ...: shows whether it had stopped growing.
    """

    rank_by_order: tuple[int, ...]


class PBHTest(NamedTuple):
    """The Popov-Belevitch-Hautus test at each eigenvalue."""

    eigenvalues: NDArray[np.complex128]
    """Of A, 1/s, shape (n,)."""
    margins: Array
    """Smallest singular value of [λI - A; C], scaled as `linear_observability` scales, shape (n,): zero at a mode
    that no output shows. At an eigenvalue repeated k times in a chain, rounding alone leaves about 1e-16^(1/k)."""


def observability_matrix(A: ArrayLike, C: ArrayLike) -> Array:
    """C, C A, ..., C A^(n-1), stacked.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n).

    Returns:
        Shape (m n, n), without any scaling: its rank is for hand calculations; `linear_observability` decides better.

    Raises:
        ConfigurationError: Other shapes, or numbers that are not finite.
    """
    a, c = _system(A, C)
    return _powers(a, c)


def linear_observability(
    A: ArrayLike, C: ArrayLike, names: Sequence[str] | None = None, tolerance: float | None = None
) -> LinearObservability:
    """What the outputs C x of x' = A x tell of x.

    The unobservable subspace is found as the largest one in the kernel of C that A maps into itself, by orthogonal
    projections, so no power of A is formed that fast and slow modes would spoil. Before, units are taken out: the
    states are scaled so that their couplings are about equally strong, A is divided by its norm and each row of C by
    its own.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n); a row of zeros measures nothing.
        names: Of the n states; x0, x1, ... if not given.
        tolerance: Singular values up to this count as zero, in scaled units; `TOLERANCE` if not given.

    Raises:
        ConfigurationError: Other shapes, numbers that are not finite, or names that are not one for each state.

    >>> # A position that is measured, and a bias on a velocity that is not:
    >>> A = [[0, 1, 1], [0, 0, 0], [0, 0, 0]]
    >>> linear_observability(A, [[1, 0, 0]], names=("x", "v", "bias")).names
    ('v - bias',)
    """
    a, c = _system(A, C)
    known = _names(names, len(a))
    tolerance = _tolerance(tolerance)
    scaled = _scaled(a, c)
    values = np.linalg.svd(_powers(scaled.a, scaled.c), compute_uv=False)
    hidden, gap = _hidden(scaled.a, scaled.c, tolerance)
    basis, _ = np.linalg.qr(scaled.units[:, None] * hidden)
    return LinearObservability(
        rank=len(a) - basis.shape[1],
        singular_values=_padded(values, len(a)),
        gap=gap,
        unobservable=basis,
        names=described_subspace(basis, known),
        time_scale_s=scaled.time_s,
        unobservable_modes=np.linalg.eigvals(basis.T @ a @ basis).astype(np.complex128),
    )


def pbh_test(A: ArrayLike, C: ArrayLike) -> PBHTest:
    """How far [λI - A; C] is from losing rank at each eigenvalue λ: a second opinion, by another way.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n).

    Raises:
        ConfigurationError: Other shapes, or numbers that are not finite.
    """
    scaled = _scaled(*_system(A, C))
    n = len(scaled.a)
    eigenvalues = np.linalg.eigvals(scaled.a).astype(np.complex128)
    pencils = eigenvalues[:, None, None] * np.eye(n) - scaled.a
    stacked = np.concatenate([pencils, np.broadcast_to(scaled.c, (n, *scaled.c.shape))], axis=1)
    margins = np.linalg.svd(stacked, compute_uv=False)[:, -1]
    return PBHTest(eigenvalues / scaled.time_s, margins)


def nonlinear_observability(
    f: Function,
    h: Function,
    x: ArrayLike,
    names: Sequence[str] | None = None,
    order: int | None = None,
    tolerance: float | None = None,
) -> NonlinearObservability:
    """What the outputs h(x) of x' = f(x) tell of the state, near x.

    The rows are the differentials of the Lie derivatives of h along f at x (Hermann and Krener 1977). They are the
    Taylor coefficients, in time, of the output's sensitivity to the initial state, and are found by running f and h
    on truncated Taylor series (`control.numerics.taylor`): no differences, no step size; rounding is all that they
    err by, and what a relative error of 1e-12 in x could make of zero counts as zero. Each output's rows are scaled
    by the time on which that output changes, and each state's column by its size (by a factor of up to a thousand),
    so that units do not decide.

    Known inputs belong into f: close over them. An input that varies is an extra state that is measured.

    Full rank is sufficient for states *near* x to be told apart, under the usual regularity; far ones may still give
    the same outputs, and nothing is said about accuracy. Lower rank is no proof that they cannot: at special states
    Lie derivatives beyond any given order may add to it, and n - 1 are not always enough. So the rank is not given up
    when it stalls: all orders up to `order` are taken, and `rank_by_order` shows them.

    Args:
        f: Rates of the states: takes an array of shape (n,), returns n numbers. Written with NumPy's functions
            (`control.taylor` lists them), not with `math`.
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
    state = _vector(x)
    known = _names(names, len(state))
    if order is not None and order < 0:
        raise ConfigurationError(f"the order of the Lie derivatives must not be negative, got {order}")
    tolerance = _tolerance(tolerance)
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
    values = _padded(values, len(state))
    return NonlinearObservability(
        rank=ranks[-1],
        singular_values=values,
        gap=_gap(values / (values[0] or 1.0), tolerance),
        unobservable=basis,
        names=described_subspace(basis, known),
        rank_by_order=ranks,
    )


def described(direction: ArrayLike, names: Sequence[str]) -> str:
    """A direction in state space as a readable combination: "p_x - p_y", "0.8 x + 0.6 y".

    Coefficients of equal size are left out, and those below 1e-8 of the largest; as a direction has no sign, the
    first one is positive.

    Args:
        direction: Shape (n,), not zero.
        names: Of the n states.

    Raises:
        ConfigurationError: Names that are not one for each state, a direction that is zero or not finite.
    """
    vector = _vector(direction)
    known = _names(names, len(vector))
    sizes = np.abs(vector)
    if not sizes.any():
        raise ConfigurationError("zero is no direction")
    shown = np.flatnonzero(sizes > _NEGLIGIBLE * sizes.max())
    if sizes[shown].min() > (1.0 - _NEGLIGIBLE) * sizes.max():
        vector = vector / sizes.max()
    text = ""
    for i in shown:
        coefficient = vector[i] * math.copysign(1.0, vector[shown[0]])
        size = f"{abs(coefficient):.3g}"
        sign = " - " if coefficient < 0.0 else " + "
        text += (sign if text else "") + (known[i] if size == "1" else f"{size} {known[i]}")
    return text


def described_subspace(basis: Array, names: Sequence[str]) -> tuple[str, ...]:
    """A basis of the same subspace that is good to read: row-reduced, so single states appear as such.

    Args:
        basis: Columns that span it, independent, shape (n, k).
        names: Of the n states.

    Returns:
        One combination for each of the k directions, each with the coefficient 1 for a state of its own.
    """
    rows = basis.T.copy()
    pivots: list[int] = []
    for i in range(len(rows)):
        sizes = np.abs(rows[i:]).max(axis=0)
        # The first state that will do; small ones would give large coefficients.
        pivot = int(np.argmax(sizes >= _PIVOT * sizes.max()))
        best = i + int(np.argmax(np.abs(rows[i:, pivot])))
        rows[[i, best]] = rows[[best, i]]
        rows[i] /= rows[i, pivot]
        others = np.arange(len(rows)) != i
        rows[others] -= rows[others, pivot][:, None] * rows[i]
        pivots.append(pivot)
    return tuple(described(rows[i], names) for i in np.argsort(pivots))


class _Scaled(NamedTuple):
    """A system without units: its states scaled, its time in `time_s`, the rows of C of length one."""

    a: Array
    c: Array
    units: Array
    time_s: float


def _scaled(a: Array, c: Array) -> _Scaled:
    units = _units(a, c)
    a = a * units / units[:, None]
    c = c * units
    rate = max(float(np.linalg.norm(a, 2)), 1.0 / LONGEST_TIME_SCALE_S)
    lengths = np.linalg.norm(c, axis=1, keepdims=True)
    return _Scaled(a / rate, c / np.where(lengths > 0.0, lengths, 1.0), units, 1.0 / rate)


def _units(a: Array, c: Array) -> Array:
    """Units of the states, shape (n,), powers of two, in which couplings between states are all about as large.

    Least squares of the entries' logarithms (Curtis and Reid, On the automatic scaling of matrices for Gaussian
    elimination, 1972), with a time scale and a gain for each output free. Unlike LAPACK's balancing, it also serves
    chains, in which nothing feeds back.
    """
    n, m = len(a), len(c)
    couplings = _weights(a - np.diag(np.diag(a)), np.abs(a).max())
    gains = _weights(c, np.abs(c).max())
    rows, right = [], []
    for (i, j), size in couplings:
        row = np.zeros(n + 1 + m)
        row[j], row[i], row[n] = 1.0, -1.0, -1.0
        rows.append(row)
        right.append(-size)
    for (k, j), size in gains:
        row = np.zeros(n + 1 + m)
        row[j], row[n + 1 + k] = 1.0, -1.0
        rows.append(row)
        right.append(-size)
    if not rows:
        return np.ones(n)
    solution = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    return np.asarray(np.exp2(np.round(solution[:n])))


def _weights(matrix: Array, largest: float) -> list[tuple[tuple[int, int], float]]:
    """Places and binary logarithms of the entries; rounding errors are no entries."""
    sizes = np.abs(matrix)
    places = np.argwhere(sizes > _NO_COUPLING * largest)
    return [((int(i), int(j)), float(np.log2(sizes[i, j]))) for i, j in places]


def _hidden(a: Array, c: Array, tolerance: float) -> tuple[Array, float]:
    """Orthonormal basis of the largest subspace in the kernel of C that A maps into itself, and the gap."""
    basis, seen = np.eye(len(a)), c
    gap = math.inf
    while basis.shape[1]:
        _, values, axes = np.linalg.svd(seen @ basis if seen is c else seen)
        rank = int((values > tolerance).sum())
        gap = min(gap, _gap(values, tolerance))
        if rank == 0:
            break
        basis = basis @ axes[rank:].T
        moved = a @ basis
        seen = moved - basis @ (basis.T @ moved)
    return basis, gap


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


def _powers(a: Array, c: Array) -> Array:
    blocks = [c]
    for _ in range(len(a) - 1):
        blocks.append(blocks[-1] @ a)
    return np.concatenate(blocks)


def _count(values: Array, tolerance: float) -> int:
    return int((values > tolerance * values[0]).sum()) if values.size and values[0] > 0.0 else 0


def _gap(values: Array, tolerance: float) -> float:
    """By how much the tolerance could be larger or smaller with the same count."""
    kept, dropped = values[values > tolerance], values[values <= tolerance]
    largest = dropped.max(initial=0.0)
    below = tolerance / largest if largest > 0.0 else math.inf
    return float(min(kept.min(initial=math.inf) / tolerance, below))


def _padded(values: NDArray[np.floating[Any]], n: int) -> Array:
    padded = np.zeros(n)
    padded[: len(values)] = values[:n]
    return padded


def _system(A: ArrayLike, C: ArrayLike) -> tuple[Array, Array]:
    (a,), (c,) = finite_arrays(A=A), finite_arrays(C=C)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or a.size == 0:
        raise ConfigurationError(f"A must be square, of shape (n, n), got {a.shape}")
    if c.ndim != 2 or c.shape[1] != len(a) or len(c) == 0:
        raise ConfigurationError(
            f"C must have a row for each output, shape (m, {len(a)}) for this A, got {c.shape}"
        )
    return a, c


def _vector(x: ArrayLike) -> Array:
    (vector,) = finite_arrays(x=x)
    if vector.ndim != 1 or vector.size == 0:
        raise ConfigurationError(f"expected a vector, of shape (n,), got shape {vector.shape}")
    return vector


def _names(names: Sequence[str] | None, n: int) -> tuple[str, ...]:
    if names is None:
        return tuple(f"x{i}" for i in range(n))
    if isinstance(names, str) or len(names) != n or len(set(names)) != n:
        raise ConfigurationError(f"expected a name of its own for each of the {n} states, got {names!r}")
    return tuple(names)


def _tolerance(tolerance: float | None) -> float:
    if tolerance is None:
        return TOLERANCE
    if not 0.0 < tolerance < 1.0:
        raise ConfigurationError(f"the tolerance is a share of the scale, between 0 and 1, got {tolerance}")
    return tolerance
