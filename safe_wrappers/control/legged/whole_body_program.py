"""The whole-body problem as a program in the control and the inner forces.

With qacc = M^-1 (B u + J' f - h), the contacts' accelerations are affine in u and f. Prescribing them determines f up
to inner forces, which cause no motion (two feet pressing against each other through a rigid ground). So the contact
forces are eliminated.

    minimise 1/2 y' H y + q' y    so that    G y <= h,  lower <= y <= upper,  c_i + C_i y in the cone,

where a cone is {(t, x): |x| <= t}, is solved by daqp or clarabel. The caller checks the answers.
"""

from typing import NamedTuple

import clarabel
import daqp
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.contact.friction_cone import tangents
from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem

_UNBOUNDED = 1e30
"""daqp's infinity."""
_ACCURACY = 1e-10
"""Tolerance for clarabel; answers of slightly lower accuracy are accepted, since the caller checks."""
_FOUND = (
    clarabel.SolverStatus.Solved,
    clarabel.SolverStatus.AlmostSolved,
    clarabel.SolverStatus.InsufficientProgress,
)
_NONE_EXISTS = (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.AlmostPrimalInfeasible)
_FAILED, _INFEASIBLE, _SOLVED = "failed", "infeasible", "solved"
_RANK = 1e-9
"""Eigenvalues of the contacts' inverse inertia below this share of the largest count as zero."""


class Program(NamedTuple):
    """The program above; H is positive definite."""

    hessian: Array  # (n, n)
    linear: Array  # (n,)
    rows: Array  # (k, n)
    limits: Array  # (k,)
    lower: Array  # (n,), -inf is no bound
    upper: Array  # (n,), inf is no bound
    cones: Array | None = None  # C_i, (m, d, n)
    cone_offsets: Array | None = None  # c_i, (m, d)

    def scaled(self) -> tuple["Program", Array]:
        """The program scaled to unit curvature along each unknown, and the factor of its answer."""
        scale = 1.0 / np.sqrt(self.hessian.diagonal())
        cones = None if self.cones is None else self.cones * scale
        return self._replace(
            hessian=self.hessian * scale * scale[:, None],
            linear=self.linear * scale,
            rows=self.rows * scale,
            lower=self.lower / scale,
            upper=self.upper / scale,
            cones=cones,
        ), scale


class Candidate(NamedTuple):
    """Answer of a solver: y, shape (n,), or None and why ("infeasible" is the solver's claim)."""

    verdict: str  # "solved", "infeasible" or "failed"
    y: Array | None


def by_daqp(program: Program) -> Candidate:
    """Active-set solution of a program without cones."""
    p, scale = program.scaled()
    n, k = p.linear.size, p.limits.size
    most = np.minimum(np.concatenate((p.upper, p.limits)), _UNBOUNDED)
    least = np.concatenate((np.maximum(p.lower, -_UNBOUNDED), np.full(k, -_UNBOUNDED)))
    y, _, flag, _ = daqp.solve(
        p.hessian, p.linear, np.ascontiguousarray(p.rows), most, least, np.zeros(n + k, np.int32)
    )
    if flag == -1:
        return Candidate(_INFEASIBLE, None)
    answer = np.asarray(y) * scale
    return Candidate(_SOLVED, answer) if flag > 0 and np.isfinite(answer).all() else Candidate(_FAILED, None)


def by_clarabel(program: Program) -> Candidate:
    """Interior-point solution, with or without cones."""
    from scipy import sparse  # here: SciPy takes a while to import

    p, scale = program.scaled()
    n = p.linear.size
    at_most, at_least = np.flatnonzero(np.isfinite(p.upper)), np.flatnonzero(np.isfinite(p.lower))
    unit = np.eye(n)
    matrix = [p.rows, unit[at_most], -unit[at_least]]
    right = [p.limits, p.upper[at_most], -p.lower[at_least]]
    count = p.limits.size + at_most.size + at_least.size
    kinds = [clarabel.NonnegativeConeT(count)] if count else []
    if p.cones is not None and p.cone_offsets is not None:
        matrix.append(-p.cones.reshape(-1, n))
        right.append(p.cone_offsets.reshape(-1))
        kinds += [clarabel.SecondOrderConeT(p.cones.shape[1])] * len(p.cones)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _ACCURACY
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(p.hessian)),
        p.linear,
        sparse.csc_matrix(np.concatenate(matrix)),
        np.concatenate(right),
        kinds,
        settings,
    ).solve()
    if solution.status in _NONE_EXISTS:
        return Candidate(_INFEASIBLE, None)
    answer = np.asarray(solution.x) * scale
    found = solution.status in _FOUND and np.isfinite(answer).all()
    return Candidate(_SOLVED, answer) if found else Candidate(_FAILED, None)


class Motion(NamedTuple):
    """`qacc = free + by_control @ u + by_force @ f`, f the stacked forces of the contacts that are to stay."""

    free: Array  # (nv,)
    by_control: Array  # (nv, nu)
    by_force: Array  # (nv, 3 s)
    axes: Array  # (3 s, r): directions in which contacts give force; without friction the normal alone
    held: Array  # (r, nv): Jacobian along these axes
    wanted: Array  # (r,), m/s^2: wanted `held @ qacc`


class Elimination(NamedTuple):
    """`f = offset + matrix @ y` with the unknowns y = (control, inner forces)."""

    offset: Array  # (3 s,), N
    matrix: Array  # (3 s, n)
    controls: int  # number of controls among the unknowns
    contradiction: Array  # (r,), m/s^2: the part of the wanted accelerations that no motion gives

    @property
    def size(self) -> int:
        """Number of unknowns, n."""
        return int(self.matrix.shape[1])

    def acceleration(self, motion: Motion) -> tuple[Array, Array]:
        """`qacc = start + slope @ y`: shapes (nv,) and (nv, n)."""
        slope = motion.by_force @ self.matrix
        slope[:, : self.controls] += motion.by_control
        return motion.free + motion.by_force @ self.offset, slope


def motion_of(problem: WholeBodyProblem) -> Motion:
    """The accelerations of a problem as a function of controls and forces."""
    nv, nu = problem.actuation.shape
    kept = problem.stance
    stacked = problem.jacobians[kept].reshape(-1, nv)
    wanted = problem.wanted[kept].reshape(-1)
    right = np.concatenate([problem.actuation, stacked.T, problem.bias[:, None]], axis=1)
    solved = np.linalg.solve(problem.inertia, right)
    axes = _axes(problem.normals[kept], problem.friction[kept])
    return Motion(-solved[:, -1], solved[:, :nu], solved[:, nu:-1], axes, axes.T @ stacked, axes.T @ wanted)


def _axes(normals: Array, friction: Array) -> Array:
    if (friction > 0.0).all():
        return np.eye(normals.size)
    blocks = [np.eye(3) if mu > 0.0 else n[:, None] for n, mu in zip(normals, friction, strict=True)]
    axes = np.zeros((normals.size, sum(block.shape[1] for block in blocks)))
    column = 0
    for row, block in enumerate(blocks):
        axes[3 * row : 3 * row + 3, column : column + block.shape[1]] = block
        column += block.shape[1]
    return axes


def eliminate(motion: Motion) -> Elimination:
    """The forces of contacts that move as wanted."""
    nu = motion.by_control.shape[1]
    missing = motion.wanted - motion.held @ motion.free
    if not missing.size:
        return Elimination(missing, np.zeros((0, nu)), nu, missing)
    compliance = motion.held @ (motion.by_force @ motion.axes)
    values, vectors = np.linalg.eigh(0.5 * (compliance + compliance.T))
    counts = values > _RANK * max(float(values[-1]), np.finfo(np.float64).tiny)
    moving, inner = vectors[:, counts], vectors[:, ~counts]
    inverse = moving / values[counts] @ moving.T
    by_control = -inverse @ (motion.held @ motion.by_control)
    # Inner forces cause no acceleration, so no control meets a wanted acceleration along them.
    contradiction = inner @ (inner.T @ missing)
    matrix = motion.axes @ np.concatenate([by_control, inner], axis=1)
    return Elimination(motion.axes @ (inverse @ missing), matrix, nu, contradiction)


class ReducedProgram(NamedTuple):
    """A program, and the contact forces as a function of its unknowns.

    Its first rows, `accelerations` of them, are of accelerations and opening contacts, the others sides of pyramids.
    """

    program: Program
    accelerations: int
    elimination: Elimination


def reduced_program(
    problem: WholeBodyProblem,
    motion: Motion,
    elimination: Elimination,
    sides: Array | None,
) -> ReducedProgram:
    """The program of a problem.

    Args:
        problem: The instant.
        motion: Of the problem.
        elimination: Of the motion.
        sides: Sides of the friction pyramids of the contacts with friction, shape (k, edges, 3); None keeps cones.
    """
    nu, n = elimination.controls, elimination.size
    start, slope = elimination.acceleration(motion)
    weighted = problem.force_weight * elimination.matrix
    hessian = weighted.T @ elimination.matrix
    linear = weighted.T @ elimination.offset
    each = np.arange(nu)
    hessian[each, each] += 1.0
    linear[:nu] -= problem.nominal
    rows, limits = _rows(problem, start, slope)
    accelerations = len(limits)
    normals, friction = problem.normals[problem.stance], problem.friction[problem.stance]
    by_contact, force = elimination.matrix.reshape(-1, 3, n), elimination.offset.reshape(-1, 3, 1)
    grips, slides = friction > 0.0, friction == 0.0
    cones = cone_offsets = None
    flat = [(slides, -normals[slides, None])]  # without friction a contact can only push
    if sides is not None:
        flat.append((grips, sides))
    elif grips.any():
        pressure = friction[grips, None, None] * normals[grips, None]
        frame = np.concatenate([pressure, tangents(normals[grips])], axis=1)
        cones, cone_offsets = frame @ by_contact[grips], (frame @ force[grips])[:, :, 0]
    rows = np.concatenate([rows, *((facing @ by_contact[some]).reshape(-1, n) for some, facing in flat)])
    limits = np.concatenate([limits, *(-(facing @ force[some]).reshape(-1) for some, facing in flat)])
    free = np.full(n - nu, np.inf)
    lower, upper = np.concatenate([problem.lower, -free]), np.concatenate([problem.upper, free])
    program = Program(hessian, linear, rows, limits, lower, upper, cones, cone_offsets)
    return ReducedProgram(program, accelerations, elimination)


def _rows(problem: WholeBodyProblem, start: Array, slope: Array) -> tuple[Array, Array]:
    """The acceleration and opening rows, in this order."""
    rows, limits = [np.zeros((0, slope.shape[1]))], [np.zeros(0)]
    if problem.acceleration_rows is not None and problem.acceleration_limits is not None:
        rows.append(problem.acceleration_rows @ slope)
        limits.append(problem.acceleration_limits - problem.acceleration_rows @ start)
    if problem.opening.size:
        normals = problem.normals[problem.opening]
        away = np.einsum("ki,kiv->kv", normals, problem.jacobians[problem.opening])
        wanted = np.einsum("ki,ki->k", normals, problem.wanted[problem.opening])
        rows.append(-away @ slope)
        limits.append(away @ start - wanted)
    return np.concatenate(rows), np.concatenate(limits)
