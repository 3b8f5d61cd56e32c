"""The minimal intervention: the control closest to the nominal one inside every half-space and the box.

Source: appendix "Minimal-intervention quadratic program" and Systems Perspective 1.1.

An admissible nominal is returned bit for bit. Otherwise daqp answers. Where it has no answer that passes the check,
least distance programming by SciPy's non-negative least squares decides (Lawson and Hanson, "Solving Least Squares
Problems", 1974, chapter 23): it is exact to rounding in thin wedges, and "infeasible" is believed only with
multipliers that prove it. Calls share no state.
"""

import functools
import math
from enum import StrEnum
from typing import Any, Final, NamedTuple

import daqp
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.control.compiled import compiled
from safe_wrappers.errors import Array, ConfigurationError

_TOLERANCE: Final = 1e-9
"""Largest residual that the nominal may have, as a share of `_scale`; answers may have ten times as much."""
_EXACT: Final = 1e-3
"""Share of what the nominal is allowed that round-off leaves. More may be far from every admissible control."""
_NARROWEST: Final = 1e-6  # share of its distance from zero below which a box's width is rounding
_ORDINARY: Final = 16.0  # half of a box; where it is wider the sizes of the numbers matter
_NO_BOUND: Final = 1e15  # a box that reaches farther (control units) bounds nothing
_UNBOUNDED: Final = 1e30  # what daqp takes as "no bound"
_LARGEST: Final = 1e150  # from here on squares may overflow
_OVERFLOWING: Final = 1e300  # an offset from here on asks for nothing
_SHORTEST: Final = 1e-150  # rows below this are zero
_ROUNDING: Final = 1e-15  # share of the numbers that are compared which round-off may leave
_OPTIMAL: Final = 1e-9  # share of the controls by which the multipliers' control may miss the answer
_DOWNHILL: Final = 1e-4  # likewise of a least squares answer
_SOFT: Final = 1e-10  # weight of the distance from the nominal beside squared violations
_FAR: Final = 1e8  # from the nominal, in the program's units: nobody looks for a control farther away
_SOFTENED: Final = 8  # daqp's mark of a row that may be violated
_SLACK, _LENGTH, _ALLOWED = range(3)
_ADMITTED, _UNUSUAL, _BAD_NOMINAL, _BAD_BOX = -1, -2, -3, -4


class Status(StrEnum):
    """How a projection ended."""

    INACTIVE = "inactive"
    """The nominal control satisfies everything; `control` is that one, bit for bit."""
    PROJECTED = "projected"
    """`control` is the closest admissible control, residual checked."""
    INFEASIBLE = "infeasible"
    """No control in the box satisfies everything; of rows, `control` violates them least."""
    FAILED = "failed"
    """No method gave an answer that passed the check; `control` is only inside the box."""


class Projection(NamedTuple):
    """An answer that has been checked."""

    control: Array  #: shape (m,), always finite and inside the box
    status: Status  #: compares equal to its string
    violation: float  #: largest `normals @ control - offsets` over all rows, at least 0, in row units


def project(
    u_nom: ArrayLike, normals: ArrayLike, offsets: ArrayLike, lower: ArrayLike, upper: ArrayLike
) -> Projection:
    """Project a nominal control onto `{u : normals @ u <= offsets, lower <= u <= upper}`.

    A nominal that misses a row by up to 1e-9 of what half of the box changes of it counts as admissible; an answer
    may miss it by ten times as much. Where the box is wide (more than 16 control units) or open, the numbers that the
    row compares take its place. An infeasible problem gives the least violation: the smallest sum of squared,
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
    return project_unchecked(u, a, b, lo, hi)


class _Problem(NamedTuple):
    """The arguments of a projection, as compiled code takes them, and what `_prepare` writes.

    In the program rows have length one and controls are of order one, by a division by a power of two, which rounds
    nothing: solvers know only absolute tolerances.
    """

    u: Array  # shape (m,)
    a: Array  # shape (k, m)
    b: Array  # shape (k,)
    lo: Array  # shape (m,)
    hi: Array  # shape (m,)
    control: Array  # the nominal, clipped to the box
    rows: Array  # shape (3, k): _SLACK, _LENGTH (0: asks for nothing), _ALLOWED, in row units
    target: Array  # of the program: u, shape (m,)
    normals: Array  # of the program, shape (k, m)
    upper: Array  # of the program: of the controls, then of the rows, shape (m + k,)
    lower: Array  # likewise

    @staticmethod
    def of(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> "_Problem":
        """Copied where compiled code would have to be compiled anew: strides, read-only memory."""
        u, a, b, lo, hi = (part if part.flags.carray else part.copy() for part in (u, a, b, lo, hi))
        m, k = u.size, b.size
        program = np.empty(m), np.empty((k, m)), np.empty(m + k), np.empty(m + k)
        return _Problem(u, a, b, lo, hi, np.empty(m), np.empty((3, k)), *program)


@compiled
def _half_width(low: float, high: float) -> float:
    """Half of what a box spans in one component, control units."""
    return min(max(0.5 * high - 0.5 * low, _NARROWEST * max(high, -low)), _UNBOUNDED)


@compiled
def _scale(box: float, length: float, values: float, widest: float) -> float:
    """What a residual is compared with, row units: how far the row's value changes over half of the box, or `values`.

    The length is that of the normal, `values` the size of the two numbers that the row compares, `widest` half of the
    box's largest width, control units.
    """
    if widest <= _ORDINARY:
        return box
    return values if box >= _NO_BOUND * length else min(box, max(values, length))


@compiled
def _prepare(p: _Problem) -> tuple[int, float]:
    """Read a problem and write what is small in it, and the program.

    Returns:
        How many rows ask for something, or a code below 0; the power of two that is one in the program.
    """
    k, m = p.a.shape
    usual, inside, within, unit = True, True, True, 1.0
    largest = farthest = widest = away = 0.0
    for j in range(m):
        x, low, high = p.u[j], p.lo[j], p.hi[j]
        if not math.isfinite(x):
            return _BAD_NOMINAL, unit
        if not low <= high:
            return _BAD_BOX, unit
        p.control[j] = min(max(x, low), high)
        inside = inside and p.control[j] == x
        usual = usual and abs(x) < _LARGEST and abs(p.control[j]) < _LARGEST
        largest, farthest = max(largest, abs(x)), max(farthest, abs(p.control[j]))
        p.target[j] = _half_width(low, high)
        widest = max(widest, p.target[j])
    for i in range(k):
        excess = -p.b[i]
        for j in range(m):
            usual = usual and abs(p.a[i, j]) < _LARGEST
            excess += p.a[i, j] * p.u[j]
        usual = usual and p.b[i] > -_OVERFLOWING
        p.rows[_ALLOWED, i] = excess
        within = within and excess <= 0.0
    if not usual:
        return _UNUSUAL, unit
    if inside and within:
        return _ADMITTED, unit
    asking, within = 0, True
    for i in range(k):
        length = box = 0.0
        for j in range(m):
            length += p.a[i, j] * p.a[i, j]
        length = math.sqrt(length)
        for j in range(m if length > 0.0 else 0):
            part = p.a[i, j] / length * p.target[j]
            box += part * part
        offset, excess = abs(p.b[i]), p.rows[_ALLOWED, i]
        p.rows[_SLACK, i] = _TOLERANCE * _scale(
            length * math.sqrt(box), length, length * largest + offset, widest
        )
        within = within and excess <= p.rows[_SLACK, i]
        rounding = _ROUNDING * (length * max(largest, farthest) + offset)
        p.rows[_ALLOWED, i] = max(_EXACT * p.rows[_SLACK, i], rounding)
        asks = length > _SHORTEST and offset < _OVERFLOWING
        p.rows[_LENGTH, i] = length if asks else 0.0
        if asks:
            away, asking = max(away, excess / length), asking + 1
    if inside and within:
        return _ADMITTED, unit
    size = widest
    if size > _ORDINARY:
        size = min(_scale(size, 1.0, max(largest, away), size), _LARGEST)
    if size > 0.0:
        while unit > size:
            unit *= 0.5
        while 2.0 * unit <= size:
            unit *= 2.0
    for j in range(m):
        p.target[j] = p.u[j] / unit
        p.upper[j], p.lower[j] = min(p.hi[j] / unit, _UNBOUNDED), max(p.lo[j] / unit, -_UNBOUNDED)
    for i in range(k):
        length = p.rows[_LENGTH, i]
        for j in range(m):
            p.normals[i, j] = p.a[i, j] / length if length > 0.0 else 0.0
        p.upper[m + i] = p.b[i] / length / unit if length > 0.0 else _UNBOUNDED
        p.lower[m + i] = -_UNBOUNDED
    return asking, unit


@compiled
def _judge(p: _Problem, unit: float, found: Array, multipliers: Array) -> tuple[bool, bool, float]:
    """Check the program's answer and write it, inside the box, to `control`.

    Returns:
        Whether it keeps the rows but for round-off, and its multipliers lead to it from the nominal; whether it
        misses none by more than an answer may; its violation.
    """
    k, m = p.a.shape
    closest, within, violation, size, widest = True, True, 0.0, 0.0, 0.0
    for j in range(m):
        finite = math.isfinite(found[j] * unit)
        closest = closest and finite
        p.control[j] = min(max(found[j] * unit if finite else p.u[j], p.lo[j]), p.hi[j])
        size = max(size, abs(p.u[j]), abs(p.control[j]))
        widest = max(widest, _half_width(p.lo[j], p.hi[j]))
    for i in range(k):
        excess = -p.b[i]
        for j in range(m):
            excess += p.a[i, j] * p.control[j]
        violation = max(violation, excess)
        within = within and excess <= 10.0 * p.rows[_SLACK, i]
        closest = closest and (excess <= 2.0 * p.rows[_ALLOWED, i] or p.rows[_LENGTH, i] == 0.0)
    for j in range(m):
        pulled, pull = p.target[j], 0.0
        for i in range(k):
            step = max(multipliers[m + i], 0.0) * p.normals[i, j]
            pulled, pull = pulled - step, pull + abs(step)
        near = _EXACT * _TOLERANCE * _scale(_half_width(p.lo[j], p.hi[j]), 1.0, size, widest)
        away = abs(min(max(pulled * unit, p.lo[j]), p.hi[j]) - p.control[j])
        closest = closest and away <= _OPTIMAL * size + 10.0 * _ROUNDING * pull * unit + near
    return closest, within, violation


def project_unchecked(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> Projection:
    """`project` for callers that have already checked types and shapes.

    Raises:
        ConfigurationError: A nominal that is not finite, or bounds that cross.
    """
    p = _Problem.of(u, a, b, lo, hi)
    asking, unit = _prepare(p)
    if asking == _ADMITTED:
        return Projection(u, Status.INACTIVE, 0.0)
    if asking == _BAD_NOMINAL:
        raise ConfigurationError(f"u_nom must be finite, got {p.u}; replace it before projecting")
    if asking == _BAD_BOX:
        raise ConfigurationError(f"lower must not exceed upper, got {p.lo} and {p.hi}")
    if asking == _UNUSUAL:  # numbers that are not finite, or too large, cannot be checked
        return Projection(p.control, Status.FAILED, math.inf)
    clipped = p.control.copy()
    closest, within, violation = _judge(p, unit, *_by_daqp(p))
    if closest:
        return Projection(p.control, _status(within), violation)
    softened = _by_daqp(p, _SOFTENED)
    proved = _prove_that_none_exists(p, softened[1])
    if not proved:  # thin, or daqp has failed
        found = _by_least_distance(p)
        proved = _prove_that_none_exists(p, found[1])
        closest, within, violation = _judge(p, unit, *_polished(p, *found))
        if closest and not proved:
            return Projection(p.control, _status(within), violation)
    if proved and bool(np.isfinite(softened[0]).all()):
        _, within, violation = _judge(p, unit, *softened)
        return Projection(p.control, _status(within), violation)
    return Projection(clipped, Status.FAILED, max(0.0, float((a @ clipped - b).max())))


def _status(within: bool) -> Status:
    return Status.PROJECTED if within else Status.INFEASIBLE


_Answer = tuple[Array, Array]
"""Of the program: the control, shape (m,), and multipliers of the box (below 0: of lower bounds) and the rows."""


def _by_daqp(p: _Problem, sense: int = 0) -> _Answer:
    """By an active set; with `_SOFTENED` rows the least violation, and of that what is closest to the nominal."""
    senses = np.zeros(len(p.upper), np.int32)
    senses[p.u.size :] = sense
    bounds = p.normals, p.upper, p.lower, senses
    tolerance = _SOFT if sense else _ROUNDING
    x, _, flag, info = daqp.solve(
        _identity(p.u.size), -p.target, *bounds, primal_tol=tolerance, rho_soft=_SOFT
    )
    return np.asarray(x) if flag > 0 else np.full(p.u.size, np.nan), np.asarray(info["lam"])


def _by_least_distance(p: _Problem) -> _Answer:
    """By non-negative least squares: its residual leads from the nominal to the answer, and vanishes without one."""
    from scipy.optimize import nnls  # here: it takes a fifth of the time of `import safe_wrappers`

    m, unit = p.u.size, _identity(p.u.size)
    above, below = np.flatnonzero(p.upper[:m] < _UNBOUNDED), np.flatnonzero(p.lower[:m] > -_UNBOUNDED)
    normals = np.vstack([unit[above], -unit[below], p.normals])
    limits = np.concatenate([p.upper[above], -p.lower[below], p.upper[m:]])
    columns = -np.vstack([normals.T, limits - normals @ p.target])
    multipliers = np.zeros(len(p.upper))
    try:
        y, _ = nnls(columns, np.append(np.zeros(m), 1.0))
    except (RuntimeError, ValueError):  # too many steps; numbers that are not finite
        return np.full(m, np.nan), multipliers
    rest = columns @ y
    scale = 1.0 - rest[-1] if rest[-1] < 1.0 else np.finfo(np.float64).eps
    y /= scale
    np.add.at(multipliers, above, y[: len(above)])
    np.subtract.at(multipliers, below, y[len(above) : len(above) + len(below)])
    multipliers[m:] = y[len(above) + len(below) :]
    return p.target + rest[:-1] / scale, multipliers


def _polished(p: _Problem, x: Array, multipliers: Array) -> _Answer:
    """What rounding leaves of the rows that hold, taken out."""
    m = p.u.size
    holds, free = multipliers[m:] > 0.0, multipliers[:m] == 0.0
    if not bool(holds.any() and np.isfinite(x).all()):
        return x, multipliers
    x = np.where(free, x, np.where(multipliers[:m] > 0.0, p.upper[:m], p.lower[:m]))
    left, part = p.upper[m:][holds] - p.normals[holds] @ x, p.normals[holds][:, free]
    x[free] += np.linalg.lstsq(part, left, rcond=None)[0]
    multipliers[m:][holds] = np.linalg.lstsq(part.T, (p.target - x)[free], rcond=None)[0]
    return x, multipliers


def _prove_that_none_exists(p: _Problem, multipliers: Array) -> bool:
    """Whether the multiples of rows and bounds contradict each other in the box (Farkas)."""
    m = p.u.size
    box, weights = multipliers[:m], np.maximum(multipliers[m:], 0.0)
    with np.errstate(all="ignore"):
        away = np.where(box > 0.0, p.upper[:m], p.lower[:m]) - p.target
        missed = -float(weights @ (p.upper[m:] - p.normals @ p.target) + box[box != 0.0] @ away[box != 0.0])
        left = float(np.linalg.norm(weights @ p.normals + box))
        reach = np.maximum(np.abs(p.upper[:m] - p.target), np.abs(p.lower[:m] - p.target))
    return missed > left * min(float(np.linalg.norm(reach)), _FAR)


@functools.cache
def _identity(n: int) -> Array:
    """Shape (n, n); shared by all callers, not to be written to."""
    return np.eye(n)


@functools.cache
def load_solvers() -> None:
    """Load what a projection needs, or compile it (seconds, once per machine), so that no control step waits."""
    one, rows = np.ones(1), (np.array([[1.0], [-1.0]]), np.array([0.5, 0.5]))
    project_unchecked(one, *rows, -one, one)
    _by_least_distance(_Problem.of(one, *rows, -one, one))


def keeps_rows(control: Array, normals: Array, offsets: Array, lower: Array, upper: Array) -> bool:
    """Whether a control satisfies every row as closely as `project` asks of its answers."""
    p = _Problem.of(control, normals, offsets, lower, upper)
    asking, unit = _prepare(p)
    if asking < 0:
        return asking == _ADMITTED
    anywhere = p._replace(lo=np.full(p.u.size, -math.inf), hi=np.full(p.u.size, math.inf))
    return _judge(anywhere, unit, p.target, np.zeros(len(p.upper)))[1]


def box_least_squares(a: Array, b: Array, lower: Array, upper: Array) -> Array:
    """The x in the box that minimises `|a x - b|^2`, shape (n,); `a` has full column rank."""
    hessian, linear, n = a.T @ a, -(a.T @ b), len(lower)
    if not n:
        return np.zeros(0)
    clipped = np.clip(np.linalg.solve(hessian, -linear), lower, upper)
    unit = float(np.abs(clipped).max()) or 1.0
    bounds = np.minimum(upper / unit, _UNBOUNDED), np.maximum(lower / unit, -_UNBOUNDED)
    x, _, flag, _ = daqp.solve(hessian, linear / unit, np.zeros((0, n)), *bounds, np.zeros(n, np.int32))
    found = np.clip(np.asarray(x) * unit, lower, upper)
    downhill = np.clip(found - (hessian @ found + linear) / np.diag(hessian), lower, upper)
    if flag > 0 and bool((np.abs(downhill - found) <= _DOWNHILL * unit).all()):
        return np.asarray(found)
    return np.asarray(clipped)  # without rows the problem cannot be infeasible: a numerical failure


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
