"""The minimal intervention: the control closest to the nominal one inside every half-space and the box.

Source: appendix "Minimal-intervention quadratic program" and Systems Perspective 1.1.

An admissible nominal is returned bit for bit. Otherwise daqp answers, and its answer is measured on the rows. Where
it misses one, daqp solves again in other units, and then with rows that may be violated; what that still violates is
infeasible.
"""

import functools
import math
from collections.abc import Iterator
from enum import StrEnum
from typing import Any, Final, NamedTuple

import daqp
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.control.compiled import compiled
from safe_wrappers.errors import Array, ConfigurationError

_TOLERANCE: Final = 1e-9
"""Largest residual of the nominal, as a share of the numbers that the row adds up."""
_ALLOWANCE: Final = 10.0  # times as much may an answer miss
_WIDE: Final = 1.0  # control units; wider boxes do not make the tolerance larger
_NO_BOUND: Final = 1e15  # a box that reaches farther (control units) bounds nothing
_UNBOUNDED: Final = 1e30  # what daqp takes as "no bound"
_ROUNDING: Final = 1e-15  # primal tolerance of daqp
_SOFT: Final = 1e-10  # weight of the distance from the nominal beside squared violations
_SOFTENED: Final = 8  # daqp's mark of a row that may be violated
Problem = tuple[Array, Array, Array, Array, Array, Any]


class Status(StrEnum):
    """How a projection ended."""

    INACTIVE = "inactive"
    """The nominal control satisfies everything; `control` is that one, bit for bit."""
    PROJECTED = "projected"
    """`control` is the closest admissible control, residual checked."""
    INFEASIBLE = "infeasible"
    """The solver finds no control in the box that satisfies everything; of rows, `control` violates them least."""
    FAILED = "failed"
    """There is no answer; `control` is only inside the box."""


class Projection(NamedTuple):
    """An answer that has been checked."""

    control: Array  #: shape (m,), always finite and inside the box
    status: Status  #: compares equal to its string
    violation: float  #: largest `normals @ control - offsets` over all rows, at least 0, in row units


def project(
    u_nom: ArrayLike, normals: ArrayLike, offsets: ArrayLike, lower: ArrayLike, upper: ArrayLike
) -> Projection:
    """Project a nominal control onto `{u : normals @ u <= offsets, lower <= u <= upper}`.

    A nominal that misses a row by up to 1e-9 of the numbers that the row adds up counts as admissible; an answer may
    miss it by ten times as much. An infeasible problem gives the least violation: the smallest sum of squared,
    normalised violations, and among those the control closest to `u_nom`.

    Args:
        u_nom: Nominal control, shape (m,), finite.
        normals: Row normals, shape (k, m); k may be 0. A zero normal with a non-negative offset is dropped, with a
            negative one it makes the problem infeasible.
        offsets: Shape (k,).
        lower: Box, shape (m,); -inf is no bound.
        upper: Box, shape (m,); +inf is no bound.

    Raises:
        ConfigurationError: Shapes do not match, bounds cross, or an argument that must be finite is not.
    """
    u = np.array(u_nom, dtype=np.float64, ndmin=1)
    a, b = np.asarray(normals, dtype=np.float64), np.asarray(offsets, dtype=np.float64).reshape(-1)
    a = a.reshape(b.size, u.size) if a.ndim < 2 and a.size == b.size * u.size else a  # one row may come flat
    if u.ndim != 1 or a.shape != (b.size, u.size):
        wanted = "u_nom (m,), normals (k, m) and offsets (k,)"
        raise ConfigurationError(f"expected {wanted}; got {u.shape}, {a.shape} and {b.shape}")
    lo, hi = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    try:
        lo, hi = (end if end.shape == u.shape else np.full(u.shape, end) for end in (lo, hi))
    except ValueError:
        raise ConfigurationError(f"expected bounds of shape {u.shape}; got {lo.shape}, {hi.shape}") from None
    if not np.isfinite(u).all():
        raise ConfigurationError(f"u_nom must be finite, got {u}; replace it before projecting")
    if not (lo <= hi).all():
        raise ConfigurationError(f"lower must not exceed upper, got {lo} and {hi}")
    return project_unchecked(u, a, b, lo, hi)


def project_unchecked(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> Projection:
    """`project` for callers that have already checked types, shapes and numbers."""
    u, a, b, lo, hi = _plain(u, a, b, lo, hi)
    control = np.minimum(np.maximum(u, lo), hi)
    share, violation = _missed(control, a, b, lo, hi)
    if share <= 1.0:
        inside = bool((control == u).all())
        return (
            Projection(u, Status.INACTIVE, 0.0)
            if inside
            else Projection(control, Status.PROJECTED, violation)
        )
    if violation == math.inf:  # a row that is not finite, or too large to be added up
        if not ((control >= lo) & (control <= hi)).all():
            raise ConfigurationError(
                f"u_nom must be finite, and bounds must not cross; got {u}, {lo} and {hi}"
            )
        return Projection(control, Status.FAILED, violation)
    for posed, sense in ((_in_one_unit, 0), (_in_widths, 0), (_in_one_unit, _SOFTENED)):
        problem = posed(u, a, b, lo, hi)
        if problem is None:
            continue
        hessian, linear, normals, upper, lower, unit = problem
        senses = np.zeros(len(upper), np.int32)
        senses[u.size :] = sense
        rows, tolerance = (normals, upper, lower, senses), _SOFT if sense else _ROUNDING
        found, _, flag, _ = daqp.solve(hessian, linear, *rows, primal_tol=tolerance, rho_soft=_SOFT)
        answer = np.minimum(np.maximum(found * unit, lo), hi)
        share, missed = _missed(answer, a, b, lo, hi)
        if flag > 0 and share <= _ALLOWANCE:
            return Projection(answer, Status.PROJECTED, missed)
    if flag > 0 and missed < math.inf:
        return Projection(np.where(a.any(axis=0), answer, control), Status.INFEASIBLE, missed)
    return Projection(control, Status.FAILED, violation)


def _plain(*arrays: Array) -> Iterator[Array]:
    """Copied where compiled code would have to be compiled anew: strides, read-only memory."""
    return (part if part.flags.carray else part.copy() for part in arrays)


def _in_one_unit(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> Problem | None:
    """What daqp is to minimise: Hessian and linear term, rows and box, and the unit of its answer."""
    return _identity(u.size), *_program(u, a, b, lo, hi)


def _in_widths(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> Problem | None:
    """The same in a unit per component; None where all are as wide.

    One unit leaves little of a component that is narrow beside the others. Each is measured by half of what the box
    spans, or by the largest number known of a component that is open.
    """
    if (hi - lo == hi[0] - lo[0]).all():
        return None
    half = 0.5 * hi - 0.5 * lo
    known = np.max([np.where(np.abs(part) < _NO_BOUND, np.abs(part), 0.0) for part in (u, lo, hi)], axis=0)
    width = np.where((half > 0.0) & (half < _NO_BOUND), half, known)
    width[width == 0.0] = 1.0
    linear, normals, upper, lower, unit = _program(u / width, a * width, b, lo / width, hi / width)
    weights = (width / width.max()) ** 2
    return np.diag(weights), linear * weights, normals, upper, lower, unit * width


@compiled
def _half_width(low: float, high: float) -> float:
    """Half of what a box spans in one component, control units; 0 where it is open."""
    half = 0.5 * high - 0.5 * low
    return half if half < _NO_BOUND else 0.0


@compiled
def _missed(x: Array, a: Array, b: Array, lo: Array, hi: Array) -> tuple[float, float]:
    """By how much a control x misses the rows: in tolerances of the worst one, and in row units.

    A tolerance is a share of the numbers that the row adds up, or would in a box of order one. Both are infinite
    where that is no number.
    """
    share = violation = 0.0
    for j in range(len(x)):
        if not lo[j] <= x[j] <= hi[j]:
            return math.inf, math.inf
    for i in range(len(b)):
        excess, size = -b[i], 0.0
        for j in range(len(x)):
            reach = max(abs(x[j]), min(_half_width(lo[j], hi[j]), _WIDE))
            excess += a[i, j] * x[j]
            size += abs(a[i, j]) * reach
        if not (size < math.inf and excess < math.inf):
            return math.inf, math.inf
        if excess > 0.0:
            share = max(share, excess / (_TOLERANCE * size) if size > 0.0 else math.inf)
            violation = max(violation, excess)
    return share, violation


@compiled
def _program(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> tuple[Array, Array, Array, Array, float]:
    """What daqp is given: linear term, normals, bounds of controls and rows from above and below, and the unit.

    Rows have length one and controls are of order one, by a division by a power of two, which rounds nothing: daqp
    knows only absolute tolerances.
    """
    k, m = a.shape
    normals, upper, lower = a.copy(), np.full(m + k, _UNBOUNDED), np.full(m + k, -_UNBOUNDED)
    size = away = widest = 0.0
    for j in range(m):
        half = _half_width(lo[j], hi[j])
        widest = max(widest, half if half > 0.0 else math.inf)
        size = max(size, min(half, _WIDE), abs(u[j]))
    for i in range(k):
        square, excess, largest = 0.0, -b[i], 0.0
        for j in range(m):
            square += a[i, j] * a[i, j]
            excess += a[i, j] * u[j]
            largest = max(largest, abs(a[i, j]))
        length = math.sqrt(square)
        if largest > 0.0 and not 0.0 < square < math.inf:  # squares outside of float64's range
            length = largest
        if length > 0.0 and b[i] < _UNBOUNDED * length:
            upper[m + i] = b[i] / length
            away = max(away, excess / length)
            for j in range(m):
                normals[i, j] = a[i, j] / length
    size = min(max(size, away), widest)
    unit = math.ldexp(1.0, math.frexp(size)[1] - 1) if 0.0 < size < math.inf else 1.0
    for j in range(m):
        upper[j], lower[j] = min(hi[j], _UNBOUNDED * unit), max(lo[j], -_UNBOUNDED * unit)
    for i in range(m + k):
        upper[i], lower[i] = min(upper[i] / unit, _UNBOUNDED), max(lower[i] / unit, -_UNBOUNDED)
    return -u / unit, normals, upper, lower, unit


@functools.cache
def _identity(n: int) -> Array:
    """Shape (n, n); shared by all callers, not to be written to."""
    return np.eye(n)


@functools.cache
def load_solvers() -> None:
    """Load what a projection needs, or compile it (seconds, once per machine), so that no control step waits."""
    one = np.ones(1)
    project_unchecked(one, np.array([[1.0], [-1.0]]), np.array([0.5, 0.5]), -one, one)


def keeps_rows(control: Array, normals: Array, offsets: Array, lower: Array, upper: Array) -> bool:
    """Whether a control satisfies every row as closely as `project` asks of its answers."""
    control, normals, offsets, lower, upper = _plain(control, normals, offsets, lower, upper)
    return _missed(control, normals, offsets, lower, upper)[0] <= _ALLOWANCE


def box_least_squares(a: Array, b: Array, lower: Array, upper: Array) -> Array:
    """The x in the box that minimises `|a x - b|^2`, shape (n,); `a` has full column rank."""
    hessian, linear, n = a.T @ a, -(a.T @ b), len(lower)
    if not n:
        return np.zeros(0)
    clipped = np.clip(np.linalg.solve(hessian, -linear), lower, upper)
    unit = float(np.abs(clipped).max()) or 1.0
    bounds = np.minimum(upper / unit, _UNBOUNDED), np.maximum(lower / unit, -_UNBOUNDED)
    x, _, flag, _ = daqp.solve(hessian, linear / unit, np.zeros((0, n)), *bounds, np.zeros(n, np.int32))
    return np.clip(np.asarray(x) * unit, lower, upper) if flag > 0 else clipped


def cast_inside(control: Array, dtype: Any, normals: Array, offsets: Array, low: Array, high: Array) -> Any:
    """A control inside its rows and a box that is exact in `dtype`, cast to it; finite where the box is not.

    Where rounding broke a row, each component moves by one unit in the last place towards feasibility.
    """
    most = np.finfo(dtype).max
    sent = np.clip(control, np.maximum(low, -most), np.minimum(high, most)).astype(dtype)
    if not offsets.size or dtype == np.float64:
        return sent
    excess = normals @ sent.astype(np.float64) - np.maximum(offsets, normals @ control)
    worst = int(excess.argmax())
    if excess[worst] <= 0.0:
        return sent
    towards = np.where(normals[worst] > 0.0, -np.inf, np.where(normals[worst] < 0.0, np.inf, sent))
    return np.clip(np.nextafter(sent, towards.astype(dtype)), low.astype(dtype), high.astype(dtype))
