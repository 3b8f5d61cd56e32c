"""The minimal intervention: the control closest to the nominal one inside every half-space and the box.

Source: appendix "Minimal-intervention quadratic program" and Systems Perspective 1.1: feasibility comes before
invariance, and clamping a projection afterwards is not the projection with a box.

The ways through, cheapest first: the nominal is feasible (returned bit for bit, no solver); one row and a box
(exact, by the breakpoints of a piecewise linear function); else a QP backend. Every answer is checked with
our own residual, whatever the solver says of it. Calls share no state, so a failed solve cannot spoil the next.

What is small is a share of the problem's own size, so that a control in N and one in MN get the same answer. Solvers
know only absolute tolerances; they get the problem divided by a power of two, which rounds nothing.
"""

import functools
import math
import operator
import warnings
from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple, cast

import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.errors import ConfigurationError, UnknownNameError

Array = NDArray[np.float64]

_SHORTEST = 1e-6
"""Rows shorter than this, or longer than its inverse, are looked at one by one before a solver sees them."""
_FEASIBILITY_TOLERANCE = 1e-9
"""Largest residual that counts as satisfied by the nominal, as a share of `_sizes`; for answers ten times as much."""
_EXACT = 1e-3
"""Share of what the nominal is allowed that round-off leaves. More may be far from every admissible control."""
_OPTIMALITY_TOLERANCE = 1e-4
"""Largest distance between a backend's answer and the one its multipliers stand for, in units of `_unit`."""
_SOLVERS_TOLERANCE = 1e-11
"""daqp's, in units of `_unit`: where rows meet at a small angle, a residual is multiplied by the angle's inverse."""
_SOFT = 1e-8
"""Weight of the distance from the nominal beside squared violations."""
_RELATIVE = 1e-6
"""A box narrower than this share of its distance from zero counts as this wide: rounding grows with the latter."""
_ORDINARY = 16.0
"""Boxes within this factor of one are not rescaled: a solver's tolerances fit them as they are."""
_NO_BOUND = 1e15
"""A box that reaches farther (control units) bounds nothing and says nothing of the size of controls."""


class Status(StrEnum):
    """How a projection ended."""

    INACTIVE = "inactive"
    """The nominal control satisfies everything; `control` is that control, bit for bit."""
    PROJECTED = "projected"
    """`control` is the closest admissible control, residual checked."""
    INFEASIBLE = "infeasible"
    """No control in the box satisfies every row; `control` violates them least."""
    FAILED = "failed"
    """No backend gave an answer that passed the check; `control` is only inside the box."""


class Projection(NamedTuple):
    """An answer that has been checked.

    Attributes:
        control: Shape (m,), always finite and inside the box.
        status: See `Status`; compares equal to its string.
        violation: Largest `normals @ control - offsets` over all rows, at least 0, in row units.
        multipliers: One per row, shape (k,), at least 0; zeros unless `projected`. With the box's own
            multipliers they make the KKT conditions hold.
        iterations: Of the backend; 0 where no solver was called.
    """

    control: Array
    status: Status
    violation: float
    multipliers: Array
    iterations: int


def project(
    u_nom: ArrayLike,
    normals: ArrayLike,
    offsets: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    solver: str = "daqp",
) -> Projection:
    """Project a nominal control onto `{u : normals @ u <= offsets, lower <= u <= upper}`.

    Args:
        u_nom: Nominal control, shape (m,), finite.
        normals: Row normals, shape (k, m); k may be 0. Rows may be degenerate: a zero normal with a
            non-negative offset is dropped, with a negative one it makes the problem infeasible.
        offsets: Shape (k,).
        lower: Box, shape (m,); -inf is no bound.
        upper: Box, shape (m,); +inf is no bound.
        solver: "daqp" (called directly) or any installed qpsolvers backend by name.

    A nominal that misses a row by up to 1e-9 of what half of the box changes of it counts as admissible; an answer
    may miss it by ten times as much. Where the box is wide (more than 16 control units) or open, the numbers that the
    row compares take its place.

    Returns:
        A `Projection`. Infeasible problems give the least-violation control: the smallest sum of squared,
        normalised violations, and among those the control closest to `u_nom`.

    Raises:
        ConfigurationError: Shapes do not match, bounds cross, or an argument that must be finite is not.
        UnknownNameError: No such solver is installed.
    """
    check_solver(solver)
    u = np.array(u_nom, dtype=np.float64, ndmin=1)
    m = u.size
    a = np.asarray(normals, dtype=np.float64)
    b = np.asarray(offsets, dtype=np.float64).reshape(-1)
    a = a.reshape(b.size, m) if a.ndim < 2 and a.size == b.size * m else a  # one row may come flat
    lo, hi = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if u.ndim != 1 or a.shape != (b.size, m):
        raise ConfigurationError(
            f"expected u_nom (m,), normals (k, m) and offsets (k,); got {u.shape}, {a.shape} and {b.shape}"
        )
    try:
        if lo.shape != u.shape or hi.shape != u.shape:
            lo, hi = np.broadcast_to(lo, (m,)), np.broadcast_to(hi, (m,))
    except ValueError:
        raise ConfigurationError(f"expected bounds of shape ({m},); got {lo.shape} and {hi.shape}") from None
    if not np.isfinite(u).all():
        raise ConfigurationError(f"u_nom must be finite, got {u}; replace it before projecting")
    if not (lo <= hi).all():  # also refuses NaN
        raise ConfigurationError(f"lower must not exceed upper, got {lo} and {hi}")
    return project_unchecked(u, a, b, lo, hi, solver)


def box_least_squares(a: Array, b: Array, lower: Array, upper: Array) -> Array:
    """The x in the box that minimises `|a x - b|^2`, shape (n,); `a` has full column rank."""
    hessian, linear = a.T @ a, -(a.T @ b)
    nearest = np.asarray(np.linalg.solve(hessian, -linear), dtype=np.float64)
    unit = _unit(_box(lower.tobytes(), upper.tobytes()), nearest, np.zeros(1), np.ones(1))
    answer = _daqp(
        hessian, linear / unit, np.zeros((0, linear.size)), np.zeros(0), lower / unit, upper / unit
    )
    # Without rows the problem cannot be infeasible; on a numerical failure the unbounded answer, clipped.
    return np.asarray(np.clip(nearest if answer is None else answer[0] * unit, lower, upper))


def check_solver(solver: str) -> None:
    """Refuse a solver that is not installed, naming those that are."""
    if solver == "daqp":
        return
    import qpsolvers  # here: it imports every solver that is installed, JAX and torch among them

    if solver not in qpsolvers.available_solvers:
        raise UnknownNameError(
            f"solver {solver!r} is not installed; installed: {', '.join(sorted(qpsolvers.available_solvers))}"
        )


def project_unchecked(u: Array, a: Array, b: Array, lo: Array, hi: Array, solver: str) -> Projection:
    """`project` for callers that have already checked types, shapes and finiteness of `u` and the box."""
    k = b.size
    if k == 1:
        return _single(u, a, b, lo, hi)
    inside = bool(((u >= lo) & (u <= hi)).all())
    if k == 0:
        status = Status.INACTIVE if inside else Status.PROJECTED
        return Projection(u if inside else np.clip(u, lo, hi), status, 0.0, np.zeros(0), 0)
    length = np.sqrt(np.einsum("ij,ij->i", a, a))
    total = float((length + b).sum())
    if total - total != 0.0:  # a NaN or an infinity somewhere
        return _finite_rows_only(u, a, b, length, lo, hi, solver)
    excess = a @ u - b
    worst, longest = float(excess.max()), float(length.max())
    if inside and worst <= 0.0:
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(k), 0)
    box = _box(lo.tobytes(), hi.tobytes())
    slack = _FEASIBILITY_TOLERANCE * _sizes(u, a, b, length, box)
    # No row's slack is larger than the longest one's over the widest component.
    near = worst <= 2.0 * _FEASIBILITY_TOLERANCE * box.widest * longest
    if inside and near and bool((excess <= slack).all()):
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(k), 0)
    unit = 1.0 if box.ordinary else _unit(box, u, excess, length)
    if solver == "daqp" and float(length.min()) * unit > _SHORTEST and longest * unit < 1.0 / _SHORTEST:
        answer = (
            _daqp(_identity(u.size), -u, a, b, lo, hi) if unit == 1.0 else _daqp_in(unit, u, a, b, lo, hi)
        )
        if answer is not None:
            control = np.minimum(np.maximum(answer[0], lo), hi)
            residual = a @ control - b
            if bool((residual <= _EXACT * slack).all()):
                violation = max(0.0, float(residual.max()))
                return Projection(control, Status.PROJECTED, violation, answer[1], answer[2])
    return _careful(u, a, b, lo, hi, length, slack, unit, solver)


def _daqp_in(
    unit: float, u: Array, a: Array, b: Array, lo: Array, hi: Array
) -> tuple[Array, Array, int] | None:
    """`_daqp` with the controls in another unit."""
    answer = _daqp(_identity(u.size), -u / unit, a * unit, b, lo / unit, hi / unit)
    return answer and (answer[0] * unit, answer[1] * (unit * unit), answer[2])


def keeps_rows(control: Array, normals: Array, offsets: Array, lower: Array, upper: Array) -> bool:
    """Whether a control satisfies every row as closely as `project` asks of its answers."""
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    size = _sizes(control, normals, offsets, length, _box(lower.tobytes(), upper.tobytes()))
    kept = normals @ control - offsets <= 10.0 * _FEASIBILITY_TOLERANCE * size
    return bool((kept & np.isfinite(length)).all())  # what overflows would be allowed anything


class _Box(NamedTuple):
    """How wide a box is.

    Attributes:
        half: Of its width, per component.
        widest: The largest of them.
        even: All are the same.
        ordinary: Controls are of order one.
    """

    half: tuple[float, ...]
    widest: float
    even: bool
    ordinary: bool


@functools.lru_cache(maxsize=256)
def _box(lower: bytes, upper: bytes) -> _Box:
    """The widths of a box, from its bounds' bytes: most boxes are asked about at every control step."""
    half = tuple(
        min(max(0.5 * top - 0.5 * bottom, _RELATIVE * max(top, -bottom)), _UNBOUNDED)
        for bottom, top in zip(np.frombuffer(lower).tolist(), np.frombuffer(upper).tolist(), strict=True)
    )
    widest = max(half, default=0.0)
    return _Box(half, widest, widest == min(half, default=0.0), 1.0 / _ORDINARY <= widest <= _ORDINARY)


def _size(box: float, length: float, values: float) -> float:
    """What a row's residual is compared with, row units.

    Args:
        box: How far the row's value changes over half of the box.
        length: Of the normal: what it changes by over one control unit.
        values: Size of the two numbers that the row compares.
    """
    if box >= _NO_BOUND * length:
        return values
    return min(box, max(values, length))


def _sizes(u: Array, a: Array, b: Array, length: Array, box: _Box) -> Array:
    """`_size` of every row, shape (k,): the box where it is narrow, the row's own numbers where it is wide."""
    if box.even:
        reach = length * box.widest
    else:
        scaled = a * np.array(box.half)
        reach = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))
    if box.widest <= _ORDINARY:
        return reach
    values = length * max(map(abs, u.tolist())) + np.abs(b)
    return np.array([*map(_size, reach.tolist(), length.tolist(), values.tolist())])


def _unit(box: _Box, u: Array, excess: Array, length: Array) -> float:
    """A power of two of the size of the controls in question."""
    size = box.widest
    if size > _ORDINARY:
        away = float((excess / np.where(length > 0.0, length, np.inf)).max())
        size = _size(size, 1.0, max(max(map(abs, u.tolist())), away))
    return math.ldexp(0.5, math.frexp(size)[1]) if size > 0.0 else 1.0


def _careful(
    u: Array,
    a: Array,
    b: Array,
    lo: Array,
    hi: Array,
    length: Array,
    slack: Array,
    unit: float,
    solver: str,
) -> Projection:
    """Row by row: which matter, which are degenerate, which cannot be met; then a backend on unit rows."""
    # What the box alone can reach decides which rows matter; a zero normal is the extreme case.
    highest, lowest = _extreme(a, lo, hi), -_extreme(-a, lo, hi)
    hopeless = bool((lowest > b + slack).any())
    keep = np.flatnonzero((highest > b) & (length > 0.0))
    rows, limits = a[keep], b[keep]
    if keep.size == 0:
        control, weights, iterations, solved = np.clip(u, lo, hi), np.zeros(0), 0, True
    elif keep.size == 1:
        one = _single(u, rows, limits, lo, hi)
        control, weights, iterations, solved = one.control, one.multipliers, 0, one.status != Status.FAILED
    else:
        norm = length[keep]
        g, h = rows / norm[:, None], limits / norm / unit
        allowed = 10.0 * slack[keep] / norm / unit
        scaled = u / unit, g, h, lo / unit, hi / unit, allowed
        control, weights, iterations, solved = _solve(*scaled, solver, hopeless)
        control, weights = np.clip(control * unit, lo, hi), weights * unit / norm
    residual = a @ control - b
    feasible = bool((residual <= slack * 10.0).all())
    violation = max(0.0, float(residual.max()))
    if feasible and solved:
        multipliers = np.zeros(b.size)
        multipliers[keep] = weights
        return Projection(control, Status.PROJECTED, violation, multipliers, iterations)
    status = Status.FAILED if (feasible or not solved) else Status.INFEASIBLE
    return Projection(control, status, violation, np.zeros(b.size), iterations)


def _finite_rows_only(
    u: Array, a: Array, b: Array, length: Array, lo: Array, hi: Array, solver: str
) -> Projection:
    """A row whose length or offset is not finite cannot be checked: respect the others, say failed."""
    # An offset of +inf asks for nothing; everything else that is not finite is a failed constraint.
    harmless = np.isfinite(length) & (b == np.inf)
    fine = np.isfinite(length) & np.isfinite(b)
    part = project_unchecked(u, a[fine], b[fine], lo, hi, solver)
    status = part.status if bool((harmless | fine).all()) else Status.FAILED
    multipliers = np.zeros(b.size)
    multipliers[fine] = part.multipliers
    violation = part.violation if status is not Status.FAILED else math.inf
    return Projection(part.control, status, violation, multipliers, part.iterations)


def _extreme(a: Array, lo: Array, hi: Array) -> Array:
    """The largest `a @ u` over the box, per row; a zero entry ignores its (possibly infinite) bound."""
    with np.errstate(invalid="ignore"):
        terms = np.where(a > 0.0, a * hi, np.where(a < 0.0, a * lo, 0.0))
    return cast(Array, terms.sum(axis=1))


def _single(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> Projection:
    """Exact projection on one half-space and the box, in scalars: at this size they beat arrays.

    The solution is `clip(u - lam * a, lo, hi)` for the smallest lam >= 0 at which `a @ clip(...)` has come
    down to the limit; that function of lam is non-increasing and piecewise linear, so its breakpoints are
    walked in order. Where it never comes down, the corner with the smallest `a @ u` violates least.
    """
    nominal, slope, low, high = u.tolist(), a[0].tolist(), lo.tolist(), hi.tolist()
    limit = float(b[0])
    square = dot = value = 0.0
    inside = True
    for x, s, bottom, top in zip(nominal, slope, low, high, strict=True):
        square += s * s
        dot += s * x
        if x < bottom or x > top:
            inside = False
            x = bottom if x < bottom else top
        if s:
            value += s * x
    if square - square != 0.0 or limit - limit != 0.0:
        return _finite_rows_only(u, a, b, np.sqrt(np.array([square])), lo, hi, "daqp")
    if inside and dot <= limit:
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(1), 0)
    length = math.sqrt(square)
    box = _box(lo.tobytes(), hi.tobytes())
    reach = length * box.widest if box.even else math.hypot(*map(operator.mul, slope, box.half))
    if box.widest > _ORDINARY:
        reach = _size(reach, length, length * max(map(abs, nominal)) + abs(limit))
    slack = _FEASIBILITY_TOLERANCE * reach
    if inside and dot - limit <= slack:
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(1), 0)
    lam = _multiplier(nominal, slope, low, high, value, limit) if value > limit and square > 0.0 else 0.0
    control, excess, falling = _moved(nominal, slope, low, high, limit, lam)
    if excess > slack and falling > 0.0:  # entries of very different size: round-off of the walk
        lam += excess / falling
        control, excess, _ = _moved(nominal, slope, low, high, limit, lam)
    if excess - excess != 0.0:  # a slope so small that the multiplier overflowed
        return Projection(np.clip(u, lo, hi), Status.FAILED, max(0.0, value - limit), np.zeros(1), 0)
    if excess <= 10.0 * slack:
        return Projection(np.array(control), Status.PROJECTED, max(0.0, excess), np.array([lam]), 0)
    return Projection(np.array(control), Status.INFEASIBLE, excess, np.zeros(1), 0)


def _moved(
    nominal: list[float], slope: list[float], low: list[float], high: list[float], limit: float, lam: float
) -> tuple[list[float], float, float]:
    """The control at a multiplier, by how much it misses the limit, and how fast that falls with the multiplier."""
    control, value, falling = [], 0.0, 0.0
    for x, s, bottom, top in zip(nominal, slope, low, high, strict=True):
        moved = min(max(x - lam * s, bottom), top) if s else min(max(x, bottom), top)
        control.append(moved)
        if s:
            value += s * moved
            if bottom < moved < top:
                falling += s * s
    return control, value - limit, falling


def _multiplier(
    nominal: list[float], slope: list[float], low: list[float], high: list[float], value: float, limit: float
) -> float:
    """The smallest lam at which the row is met, or the one at which every component has hit its bound."""
    falling = 0.0  # -d value / d lam on the current stretch
    events: list[tuple[float, float]] = []
    for x, s, bottom, top in zip(nominal, slope, low, high, strict=True):
        if not s:
            continue
        enter, leave = ((x - top) / s, (x - bottom) / s) if s > 0.0 else ((x - bottom) / s, (x - top) / s)
        if leave <= 0.0:
            continue
        if enter <= 0.0:
            falling += s * s
        else:
            events.append((enter, s * s))
        if leave < math.inf:
            events.append((leave, -s * s))
    lam = 0.0
    events.sort()
    for at, change in events:
        if value - falling * (at - lam) <= limit:
            break
        value -= falling * (at - lam)
        lam = at
        falling += change
    if value > limit and falling > 1e-300:
        lam += (value - limit) / falling
    return lam


Backend = Callable[[Array, Array, Array, Array, Array, Array], tuple[Array, Array, int] | None]
"""(P, q, G, h, lower, upper) -> (x, row multipliers, iterations), or None when it gave up."""


_UNBOUNDED = 1e30
"""What daqp takes as "no bound"."""


@functools.cache
def _identity(n: int) -> Array:
    return np.eye(n)


@functools.cache
def _no_lower(k: int) -> Array:
    return np.full(k, -_UNBOUNDED)


@functools.cache
def _sense(n: int) -> NDArray[np.int32]:
    return np.zeros(n, np.int32)


def _daqp(p: Array, q: Array, g: Array, h: Array, lo: Array, hi: Array) -> tuple[Array, Array, int] | None:
    n, k = q.size, h.size
    upper = np.minimum(np.concatenate((hi, h)), _UNBOUNDED)
    lower = np.maximum(np.concatenate((lo, _no_lower(k))), -_UNBOUNDED)
    # daqp writes to the sense, so it gets a copy.
    x, _, flag, info = daqp.solve(
        p, q, np.ascontiguousarray(g), upper, lower, _sense(n + k).copy(), primal_tol=_SOLVERS_TOLERANCE
    )
    if flag < 1:
        return None
    return np.asarray(x), np.maximum(info["lam"][n:], 0.0), int(info["iterations"])


def _named(name: str) -> Backend:
    import qpsolvers

    def solve(
        p: Array, q: Array, g: Array, h: Array, lo: Array, hi: Array
    ) -> tuple[Array, Array, int] | None:
        problem = qpsolvers.Problem(p, q, g, h, lb=lo, ub=hi)
        try:
            with warnings.catch_warnings():  # of matrix conversions and of statuses, which we check ourselves
                warnings.simplefilter("ignore")
                solution = qpsolvers.solve_problem(problem, solver=name)
        except (qpsolvers.exceptions.QPError, ValueError, ArithmeticError):
            return None
        if not solution.found or solution.x is None:
            return None
        dual = solution.z if solution.z is not None else np.zeros(h.size)
        return np.asarray(solution.x), np.maximum(np.asarray(dual), 0.0), 0

    return solve


def _solve(
    u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array, solver: str, hopeless: bool
) -> tuple[Array, Array, int, bool]:
    """Several unit rows and a box by a QP backend; least violation where they contradict each other."""
    backend = _daqp if solver == "daqp" else _named(solver)
    if not hopeless:
        answer = _nearest(backend, u, g, h, lo, hi, allowed)
        if answer is None and solver != "daqp":  # its failure does not make the problem infeasible
            answer = _nearest(_daqp, u, g, h, lo, hi, allowed)
        if answer is not None:
            exact = bool((g @ answer[0] - h <= 0.1 * _EXACT * allowed).all())
            return *(answer if exact else _by_distance(u, g, h, lo, hi, allowed) or answer), True
    least = _least_violation(backend, u, g, h, lo, hi)
    if least is None and solver != "daqp":
        least = _least_violation(_daqp, u, g, h, lo, hi)
    # If some control keeps the rows, the least violation is at most what the soft weight makes of its distance.
    thin = 2.0 * math.sqrt(_SOFT) * float(np.linalg.norm(hi - lo))
    if not hopeless and (least is None or float((g @ least - h).max()) <= thin):
        answer = _by_distance(u, g, h, lo, hi, allowed)
        if answer is not None:
            return *answer, True
    if least is None:
        return np.clip(u, lo, hi), np.zeros(h.size), 0, False
    # Closest to the nominal among those that violate (about) as little.
    relaxed = np.maximum(h, g @ least) + 0.1 * allowed
    answer = _nearest(_daqp, u, g, relaxed, lo, hi, allowed)
    if answer is None:
        return least, np.zeros(h.size), 0, True
    return *answer, True


def _nearest(
    backend: Backend, u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array
) -> tuple[Array, Array, int] | None:
    answer = backend(_identity(u.size), -u, g, h, lo, hi)
    if answer is None:
        return None
    x, multipliers, iterations = answer
    x = np.clip(x, lo, hi)  # removes the backend's round-off at the box; the residual is checked after it
    if not np.isfinite(x).all() or bool((g @ x - h > allowed).any()):
        polished = _polish(u, g, h, lo, hi, allowed, x, multipliers)
        if polished is None:
            return None
        x = polished
    # Feasible is not yet closest: the multipliers must lead from the nominal to the answer.
    if float(np.abs(np.clip(u - multipliers @ g, lo, hi) - x).max()) > _OPTIMALITY_TOLERANCE:
        return None
    return x, multipliers, iterations


def _by_distance(
    u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array
) -> tuple[Array, Array, int] | None:
    """The projection by non-negative least squares (Lawson and Hanson, Solving Least Squares Problems, ch. 23).

    Where rows oppose each other at a small angle, a small residual can be far from every admissible control, and a
    solver that works with residuals takes the rows for contradictory. Here the residual of the least squares is
    `1 / sqrt(1 + distance^2)`, so whether a control exists is decided by how far away it is.
    """
    from scipy.optimize import nnls  # here: few need it, and it takes a while to import

    above, below = np.flatnonzero(np.isfinite(hi)), np.flatnonzero(np.isfinite(lo))
    rows = np.vstack([g, _identity(u.size)[above], -_identity(u.size)[below]])
    room = np.concatenate([h - g @ u, hi[above] - u[above], u[below] - lo[below]])
    system = -np.vstack([rows.T, room])
    aim = np.append(np.zeros(u.size), 1.0)
    try:
        weights, _ = nnls(system, aim)
    except RuntimeError:  # too many iterations
        return None
    left = aim - system @ weights
    if not left[-1] > 0.0:
        return None
    x = np.clip(u - left[:-1] / left[-1], lo, hi)
    multipliers = weights[: h.size] / left[-1]
    polished = _polish(u, g, h, lo, hi, allowed, x, multipliers)
    x = x if polished is None else polished
    return (x, multipliers, 0) if bool((g @ x - h <= allowed).all()) else None


def _polish(
    u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array, x: Array, multipliers: Array
) -> Array | None:
    """Solve the equalities of the active set that a first-order or interior-point backend has pointed to."""
    if not np.isfinite(x).all():
        return None
    active = multipliers > 1e-6 * max(1.0, float(multipliers.max(initial=0.0)))
    free = (x > lo + 1e-7) & (x < hi - 1e-7)
    if not active.any() or not free.any():
        return None
    fixed = np.where(free, 0.0, np.where(np.abs(x - lo) < np.abs(x - hi), lo, hi))
    fixed[free] = 0.0
    part = g[np.ix_(active, free)]
    need = h[active] - g[active][:, ~free] @ fixed[~free] - part @ u[free]
    step = np.linalg.lstsq(part, need, rcond=None)[0]
    polished = fixed.copy()
    polished[free] = u[free] + step
    inside = bool((polished >= lo).all() and (polished <= hi).all())
    if not inside or bool((g @ polished - h > allowed).any()):
        return None
    return polished


def _least_violation(backend: Backend, u: Array, g: Array, h: Array, lo: Array, hi: Array) -> Array | None:
    """Minimise the squared violations of unit rows over the box; the box itself is never softened."""
    m, k = u.size, h.size
    weight = np.concatenate([np.full(m, _SOFT), np.ones(k)])
    linear = np.concatenate([-_SOFT * u, np.zeros(k)])
    rows = np.hstack([g, -np.eye(k)])
    answer = backend(
        np.diag(weight),
        linear,
        rows,
        h,
        np.concatenate([lo, np.zeros(k)]),
        np.concatenate([hi, np.full(k, np.inf)]),
    )
    if answer is None or not np.isfinite(answer[0]).all():
        return None
    return cast(Array, np.clip(answer[0][:m], lo, hi))
