"""Whole-body control: the torques closest to the nominal ones for which feasible contact forces exist.

    M qacc + h = B u + sum J_k' f_k,

with every f_k in its friction cone, u in the actuators' box, and the contacts' points moving as wanted. A solution
says that such forces exist at this instant, not that the same holds a control step later.

The wanted accelerations `J qacc` determine f up to inner forces, which cause no motion (two feet pressing against
each other through a rigid ground). So the unknowns are y = (u, inner forces):

    minimise 1/2 y' H y + q' y    so that    G y <= g,  lower <= y <= upper,  c_i + C_i y in {(t, x): |x| <= t},

by daqp, or by clarabel where there are cones. Every answer is checked by the residuals of the problem.

Source: appendix "Floating-base equations of motion" and "Hierarchical whole-body control quadratic program".
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import clarabel
import daqp
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.contact import cone_excess, friction_pyramid, tangents
from safe_wrappers.control.projection import Status
from safe_wrappers.errors import Array, ConfigurationError, finite_array

TOLERANCE = 1e-6
"""Largest residual that counts as met: relative to 1 plus the size of the forces (N) or accelerations (m/s^2)."""
_UNBOUNDED = 1e30
"""daqp's infinity."""
_ACCURACY = 1e-10
"""Tolerance for clarabel; answers of slightly lower accuracy are accepted, since they are checked."""
_FOUND = (
    clarabel.SolverStatus.Solved,
    clarabel.SolverStatus.AlmostSolved,
    clarabel.SolverStatus.InsufficientProgress,
)
_NONE_EXISTS = (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.AlmostPrimalInfeasible)
_RANK = 1e-9
"""Eigenvalues of the contacts' inverse inertia below this share of the largest count as zero."""


@dataclass(frozen=True, eq=False)
class WholeBodyProblem:
    """One instant of a robot in contact."""

    inertia: Array  #: M, shape (nv, nv), positive definite
    bias: Array  #: h, shape (nv,): Coriolis, centrifugal and gravity forces minus passive ones
    actuation: Array  #: B, shape (nv, nu): generalised force per control
    jacobians: Array  #: J_k of the contact points, shape (k, 3, nv); k may be 0
    drift: Array  #: `dJ/dt qvel` of the contact points, shape (k, 3), m/s^2
    normals: Array  #: unit normals, pointing at the body that the forces push, shape (k, 3)
    friction: Array  #: coefficients, at least 0, shape (k,); at 0 a contact acts along its normal only
    lower: Array  #: smallest control, shape (nu,)
    upper: Array  #: largest control, shape (nu,)
    nominal: Array  #: the control whose distance is minimised, shape (nu,)
    contact_acceleration: Array | None = (
        None  #: wanted at the contact points, shape (k, 3), m/s^2; None is zero
    )
    force_weight: float = 1e-8  #: of the squared forces, per N^2: it chooses among forces of equal effect
    breaking: NDArray[np.bool_] | None = None
    """Contacts that are to open, shape (k,): force 0, normal acceleration at least the wanted; None: none."""
    first_tangents: Array | None = (
        None  #: direction of each pyramid's first edge, shape (k, 3); None: a default
    )
    accelerations: tuple[Array, Array] | None = (
        None  #: rows `G qacc <= g`, shapes (m, nv) and (m,); None: none
    )
    stance: NDArray[np.intp] = field(init=False)  #: indices of the contacts that are to stay
    opening: NDArray[np.intp] = field(init=False)  #: indices of the contacts that are to open
    wanted: Array = field(init=False)
    """Wanted `J qacc`: `contact_acceleration`, or zeros, minus the drift, shape (k, 3)."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray) and name not in ("lower", "upper"):
                finite_array(name, value)
        if not (self.lower <= self.upper).all():
            raise ConfigurationError(f"lower must not exceed upper, got {self.lower} and {self.upper}")
        if not (self.friction >= 0.0).all():
            raise ConfigurationError(f"friction must be 0 or more, got {self.friction}")
        opens = np.zeros(len(self.normals), bool) if self.breaking is None else self.breaking
        acceleration = 0.0 if self.contact_acceleration is None else self.contact_acceleration
        object.__setattr__(self, "stance", np.flatnonzero(~opens))
        object.__setattr__(self, "opening", np.flatnonzero(opens))
        object.__setattr__(self, "wanted", acceleration - self.drift)


class WholeBodySolution(NamedTuple):
    """A checked answer; without one (infeasible, failed) the nominal control, clipped to the box, and no forces.

    Its violations, each at least 0, are evaluated from the answer itself.
    """

    control: Array  #: shape (nu,), finite and inside the box
    acceleration: Array  #: qacc under it and the forces, shape (nv,)
    forces: Array  #: at the contacts, shape (k, 3), N, each inside its cone (and pyramid)
    status: Status
    contact_error: float  #: largest error of a contact's acceleration, m/s^2; of an opening one its shortfall
    cone_error: float  #: largest violation of an exact friction cone, N, also where a pyramid was used


def solve_pyramid(problem: WholeBodyProblem, edges: int = 4) -> WholeBodySolution:
    """Solve with friction pyramids of so many edges, at least 3: a quadratic program, conservative, by daqp."""
    grips = problem.stance[problem.friction[problem.stance] > 0.0]
    first = None if problem.first_tangents is None else problem.first_tangents[grips]
    pyramids = friction_pyramid(problem.normals[grips], problem.friction[grips], edges, first)
    return _solve(problem, pyramids[:, :-1])  # the sides imply that nothing pulls


def solve_cone(problem: WholeBodyProblem) -> WholeBodySolution:
    """Solve with the exact friction cones: a second-order cone program, by clarabel."""
    return _solve(problem, None)


def rigid_forces(problem: WholeBodyProblem, control: Array) -> Array:
    """The contact forces that give the wanted contact accelerations under a control (nu,), feasible or not.

    Shape (k, 3), N, the smallest ones where they are not unique and 0 at contacts that are to open. Contradictory
    accelerations are met as closely as possible.
    """
    rigid = _eliminate(problem)
    return rigid.forces(problem, np.concatenate([control, np.zeros(rigid.matrix.shape[1] - len(control))]))


def attainable_contact_acceleration(problem: WholeBodyProblem) -> Array:
    """The contact accelerations closest to the wanted ones that do not contradict each other, shape (k, 3), m/s^2.

    By kinematics alone. Contradictory accelerations make a problem infeasible.
    """
    axes, held, wanted = _held(problem)
    change = axes @ (held @ np.linalg.lstsq(held, wanted, rcond=1e-5)[0] - wanted)
    attainable = problem.wanted + problem.drift
    attainable[problem.stance] += change.reshape(-1, 3)
    return np.asarray(attainable)


class _Rigid(NamedTuple):
    """While contacts move as wanted: `f = offset + matrix @ y` of those that stay, and `qacc = start + slope @ y`."""

    offset: Array  # (3 s,), N
    matrix: Array  # (3 s, n)
    start: Array  # (nv,)
    slope: Array  # (nv, n)
    contradiction: float  # largest part of the wanted accelerations that no motion gives, m/s^2

    def forces(self, problem: WholeBodyProblem, y: Array) -> Array:
        """At all contacts, shape (k, 3)."""
        forces = np.zeros(problem.normals.shape)
        forces[problem.stance] = (self.offset + self.matrix @ y).reshape(-1, 3)
        return forces


def _held(problem: WholeBodyProblem) -> tuple[Array, Array, Array]:
    """Directions in which contacts that stay give force, (3 s, r), the Jacobian along them, the wanted `J qacc`."""
    normals, friction = problem.normals[problem.stance], problem.friction[problem.stance]
    axes = np.eye(normals.size)
    if not (friction > 0.0).all():  # without friction the normal alone
        from scipy.linalg import block_diag  # here: SciPy takes a while to import

        both = zip(normals, friction, strict=True)
        axes = block_diag(*(np.eye(3) if mu > 0.0 else n[:, None] for n, mu in both))
    stacked = problem.jacobians[problem.stance].reshape(-1, len(problem.bias))
    return axes, axes.T @ stacked, axes.T @ problem.wanted[problem.stance].reshape(-1)


def _eliminate(problem: WholeBodyProblem) -> _Rigid:
    nu = len(problem.nominal)
    axes, held, wanted = _held(problem)
    stacked = problem.jacobians[problem.stance].reshape(-1, len(problem.bias))
    right = np.concatenate([problem.actuation, stacked.T, problem.bias[:, None]], axis=1)
    solved = np.linalg.solve(problem.inertia, right)
    by_control, by_force, free = solved[:, :nu], solved[:, nu:-1], -solved[:, -1]
    missing = wanted - held @ free
    compliance = held @ (by_force @ axes)
    values, vectors = np.linalg.eigh(0.5 * (compliance + compliance.T))
    counts = values > _RANK * values.max(initial=np.finfo(np.float64).tiny)
    moving, inner = vectors[:, counts], vectors[:, ~counts]
    inverse = moving / values[counts] @ moving.T
    matrix = axes @ np.concatenate([-inverse @ (held @ by_control), inner], axis=1)
    offset = axes @ (inverse @ missing)
    slope = by_force @ matrix
    slope[:, :nu] += by_control
    # Inner forces cause no acceleration, so no control meets a wanted acceleration along them.
    contradiction = float(np.abs(inner @ (inner.T @ missing)).max(initial=0.0))
    return _Rigid(offset, matrix, free + by_force @ offset, slope, contradiction)


class Program(NamedTuple):
    """The program above; H is positive definite."""

    hessian: Array  # (n, n)
    linear: Array  # (n,)
    rows: Array  # (k, n): of accelerations, then sides of pyramids
    limits: Array  # (k,)
    lower: Array  # (n,), -inf is no bound
    upper: Array  # (n,), inf is no bound
    cones: Array  # C_i, (m, 3, n)
    cone_offsets: Array  # c_i, (m, 3)


def _solve(problem: WholeBodyProblem, sides: Array | None) -> WholeBodySolution:
    """With the sides of pyramids, shape (k, edges, 3), for the contacts that stay and have friction; None: cones."""
    rigid, nominal, nu = _eliminate(problem), problem.nominal, len(problem.nominal)
    status, found = Status.INFEASIBLE, None
    if rigid.contradiction <= _tolerance(problem.wanted):
        program = _program(problem, rigid, sides)
        nothing = np.zeros(len(program.linear) - nu)
        found = _checked(problem, rigid, program, nominal, nothing, Status.INACTIVE)
        y = None if found else _optimum(program)
        if isinstance(y, Status):
            status = y
        elif y is not None:
            status = Status.FAILED
            found = _checked(problem, rigid, program, nominal, y[nu:], Status.INACTIVE)
            found = found or _checked(problem, rigid, program, y[:nu], y[nu:], Status.PROJECTED)
    if found is not None:
        return found
    # Nothing passed: the nominal control clipped to its box, contacts without force.
    control = np.clip(nominal, problem.lower, problem.upper)
    return _answer(problem, control, np.zeros(problem.normals.shape), status)


def _tolerance(sizes: Array) -> float:
    return TOLERANCE * (1.0 + float(np.abs(sizes).max(initial=0.0)))


def _checked(
    problem: WholeBodyProblem, rigid: _Rigid, program: Program, control: Array, inner: Array, status: Status
) -> WholeBodySolution | None:
    """The answer of a control and inner forces, or None if it is outside the box or its residuals are too large."""
    inside = np.clip(control, problem.lower, problem.upper)
    allowed = TOLERANCE if status is Status.PROJECTED else 0.0  # a solver's round-off at the box
    if not float(np.abs(control - inside).max(initial=0.0)) <= allowed:
        return None
    y = np.concatenate([inside, inner])
    executed = inside if status is Status.PROJECTED else control
    answer = _answer(problem, executed, rigid.forces(problem, y), status)
    soft = len(_acceleration_rows(problem)[1])
    over, force = program.rows @ y - program.limits, _tolerance(answer.forces)
    size = np.abs(program.rows[:soft]) @ np.abs(y)
    fine = (
        answer.cone_error <= force
        and bool((over[soft:] <= force).all())
        and bool((over[:soft] <= TOLERANCE * (1.0 + size)).all())
        and answer.contact_error <= _tolerance(problem.wanted)
    )
    return answer if fine else None


def _answer(problem: WholeBodyProblem, control: Array, forces: Array, status: Status) -> WholeBodySolution:
    """With residuals from the problem's own matrices, independent of the elimination."""
    pushed = np.einsum("kiv,ki->v", problem.jacobians, forces)
    acceleration = np.linalg.solve(problem.inertia, problem.actuation @ control + pushed - problem.bias)
    missed = problem.jacobians @ acceleration - problem.wanted
    along = np.einsum("ki,ki->k", missed, problem.normals)
    stays, opens = problem.stance, problem.opening
    # Without friction a contact holds along its normal alone.
    grips = problem.friction[stays, None] > 0.0
    held = np.where(grips, np.abs(missed[stays]), np.abs(along[stays, None]))
    error = max(float(held.max(initial=0.0)), float((-along[opens]).max(initial=0.0)))
    cone = float(cone_excess(forces, problem.normals, problem.friction).max(initial=0.0))
    return WholeBodySolution(control, acceleration, forces, status, error, cone)


def _acceleration_rows(problem: WholeBodyProblem) -> tuple[Array, Array]:
    """G and g of `G qacc <= g`, those of contacts that open included."""
    normals = problem.normals[problem.opening]
    away = np.einsum("ki,kiv->kv", normals, problem.jacobians[problem.opening])
    least = np.einsum("ki,ki->k", normals, problem.wanted[problem.opening])
    if problem.accelerations is None:
        return -away, -least
    rows, limits = problem.accelerations
    return np.concatenate([rows, -away]), np.concatenate([limits, -least])


def _program(problem: WholeBodyProblem, rigid: _Rigid, sides: Array | None) -> Program:
    nu, n = len(problem.nominal), rigid.matrix.shape[1]
    weighted = problem.force_weight * rigid.matrix
    hessian, linear = weighted.T @ rigid.matrix, weighted.T @ rigid.offset
    hessian[np.arange(nu), np.arange(nu)] += 1.0
    linear[:nu] -= problem.nominal
    accelerations, most = _acceleration_rows(problem)
    rows, limits = [accelerations @ rigid.slope], [most - accelerations @ rigid.start]
    normals, friction = problem.normals[problem.stance], problem.friction[problem.stance]
    by_contact, force = rigid.matrix.reshape(-1, 3, n), rigid.offset.reshape(-1, 3, 1)
    grips = friction > 0.0
    # Without friction a contact can only push.
    for some, facing in ((~grips, -normals[~grips, None]), (grips, sides)):
        if facing is not None:
            rows.append((facing @ by_contact[some]).reshape(-1, n))
            limits.append(-(facing @ force[some]).reshape(-1))
    exact = grips & (sides is None)
    pressure = friction[exact, None, None] * normals[exact, None]
    frame = np.concatenate([pressure, tangents(normals[exact])], axis=1)
    free = np.full(n - nu, np.inf)
    box = np.concatenate([problem.lower, -free]), np.concatenate([problem.upper, free])
    cones = frame @ by_contact[exact], (frame @ force[exact])[:, :, 0]
    return Program(hessian, linear, np.concatenate(rows), np.concatenate(limits), *box, *cones)


def _optimum(program: Program) -> Array | Status:
    """By daqp where there are no cones; by clarabel as well before infeasibility is accepted."""
    scale = 1.0 / np.sqrt(program.hessian.diagonal())  # to unit curvature along each unknown
    scaled = program._replace(
        hessian=program.hessian * scale * scale[:, None],
        linear=program.linear * scale,
        rows=program.rows * scale,
        lower=program.lower / scale,
        upper=program.upper / scale,
        cones=program.cones * scale,
    )
    y = Status.FAILED if len(program.cones) else by_daqp(scaled)
    if isinstance(y, Status):
        y = by_clarabel(scaled)
    return y if isinstance(y, Status) else y * scale


def by_daqp(p: Program) -> Array | Status:
    """The y of a program without cones, shape (n,), by an active set; or why there is none."""
    n, k = p.linear.size, p.limits.size
    most = np.minimum(np.concatenate((p.upper, p.limits)), _UNBOUNDED)
    least = np.concatenate((np.maximum(p.lower, -_UNBOUNDED), np.full(k, -_UNBOUNDED)))
    y, _, flag, _ = daqp.solve(
        p.hessian, p.linear, np.ascontiguousarray(p.rows), most, least, np.zeros(n + k, np.int32)
    )
    if flag == -1:
        return Status.INFEASIBLE
    return np.asarray(y) if flag > 0 and np.isfinite(y).all() else Status.FAILED


def by_clarabel(p: Program) -> Array | Status:
    """The y of a program, shape (n,), by an interior point method; or why there is none."""
    from scipy import sparse  # here: SciPy takes a while to import

    at_most, at_least, unit = np.isfinite(p.upper), np.isfinite(p.lower), np.eye(p.linear.size)
    matrix = np.concatenate([p.rows, unit[at_most], -unit[at_least], -p.cones.reshape(-1, p.linear.size)])
    right = np.concatenate([p.limits, p.upper[at_most], -p.lower[at_least], p.cone_offsets.reshape(-1)])
    flat = len(right) - p.cone_offsets.size
    kinds = [clarabel.NonnegativeConeT(flat)] if flat else []
    kinds += [clarabel.SecondOrderConeT(3)] * len(p.cones)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _ACCURACY
    hessian = sparse.csc_matrix(np.triu(p.hessian))
    solver = clarabel.DefaultSolver(hessian, p.linear, sparse.csc_matrix(matrix), right, kinds, settings)
    solution = solver.solve()
    if solution.status in _NONE_EXISTS:
        return Status.INFEASIBLE
    y = np.asarray(solution.x)
    return y if solution.status in _FOUND and np.isfinite(y).all() else Status.FAILED


def largest_acceleration(distance: Array, speed: Array, horizon_s: float) -> Array:
    """The largest constant acceleration that stays within a limit until a horizon > 0, shape (...).

    The distance to the limit is in m or rad, the speed towards it in m/s or rad/s. From beyond the limit (a negative
    distance): the largest that returns to it by the end of the horizon.
    """
    at_end = 2.0 * (distance - horizon_s * speed) / horizon_s**2
    # Where the top of the parabola is before the end, the top may just reach the limit.
    top_is_inside = (distance > 0.0) & (2.0 * distance < horizon_s * speed)
    with np.errstate(over="ignore"):  # very close to the limit: the largest finite number
        at_top = -(speed * speed) / (2.0 * np.where(distance > 0.0, distance, 1.0))
    return np.asarray(np.where(top_is_inside, np.maximum(at_top, -np.finfo(np.float64).max), at_end))


def predicted_position_rows(
    dofs: NDArray[np.intp],
    positions: Array,
    velocities: Array,
    lower: Array,
    upper: Array,
    horizon_s: float,
    nv: int,
) -> tuple[Array, Array]:
    """Rows `G qacc <= g`, shapes (m, nv) and (m,), that keep joints in range until the horizon, upper limits first.

    A bound at the present position does not cover the motion between samples. The acceleration is constant; there is
    one row for each finite limit. Slides and hinges are given by their degrees of freedom among the model's nv, their
    positions, velocities and ranges, shape (n,), m or rad; the horizon is a control step, or the time that stopping
    takes if that is longer.
    """
    above, below, units = np.isfinite(upper), np.isfinite(lower), np.eye(nv)[dofs]
    rows = np.concatenate([units[above], 0.0 - units[below]])  # 0 - x: no negative zeros
    upwards = largest_acceleration((upper - positions)[above], velocities[above], horizon_s)
    downwards = largest_acceleration((positions - lower)[below], -velocities[below], horizon_s)
    return rows, np.concatenate([upwards, downwards])
