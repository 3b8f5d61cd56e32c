"""Whole-body control: the torques closest to the nominal ones for which feasible contact forces exist.

    M qacc + h = B u + sum J_k' f_k,

with every f_k in its friction cone, u in the actuators' box, and the contacts' points moving as wanted. A solution
says that such forces exist at this instant, not that the same holds a control step later.

The equation of motion gives qacc, so that the unknowns of the program are y = (u, f):

    minimise |u - nominal|^2 + weight |f|^2 so that E y = e,  G y <= g,  C_i y in {(t, x): |x| <= t},

by clarabel. Every answer is checked by the residuals of the problem.

Source: appendix "Floating-base equations of motion" and "Hierarchical whole-body control quadratic program".
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import clarabel
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.contact import cone_excess, friction_pyramid, tangents
from safe_wrappers.control.projection import Status
from safe_wrappers.errors import Array

TOLERANCE = 1e-6
"""Largest residual that counts as met: relative to 1 plus the size of the forces (N) or accelerations (m/s^2)."""
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
    """One instant of a robot in contact; all numbers but the bounds are finite, which is not checked."""

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
    contact_acceleration: Array | float = 0.0  #: wanted at the contact points, shape (k, 3), m/s^2
    force_weight: float = 1e-8  #: of the squared forces, per N^2: it chooses among forces of equal effect
    breaking: NDArray[np.bool_] | None = None
    """Contacts that are to open, shape (k,): force 0, normal acceleration at least the wanted; None: none."""
    stance: NDArray[np.intp] = field(init=False)  #: indices of the contacts that are to stay
    opening: NDArray[np.intp] = field(init=False)  #: indices of the contacts that are to open
    wanted: Array = field(
        init=False
    )  #: wanted `J qacc`, `contact_acceleration` minus the drift, shape (k, 3)

    def __post_init__(self) -> None:
        opens = np.zeros(len(self.normals), bool) if self.breaking is None else self.breaking
        object.__setattr__(self, "stance", np.flatnonzero(~opens))
        object.__setattr__(self, "opening", np.flatnonzero(opens))
        object.__setattr__(self, "wanted", self.contact_acceleration - self.drift)


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
    """Solve with friction pyramids of so many edges, at least 3: a quadratic program, conservative."""
    grips = problem.stance[problem.friction[problem.stance] > 0.0]
    return _solve(problem, friction_pyramid(problem.normals[grips], problem.friction[grips], edges))


def solve_cone(problem: WholeBodyProblem) -> WholeBodySolution:
    """Solve with the exact friction cones: a second-order cone program."""
    return _solve(problem, None)


def rigid_forces(problem: WholeBodyProblem, control: Array) -> Array:
    """The contact forces that give the wanted contact accelerations under a control (nu,), feasible or not.

    Shape (k, 3), N, the smallest ones where they are not unique and 0 at contacts that are to open. Contradictory
    accelerations are met as closely as possible.
    """
    motion = _Motion(problem)
    return motion.spread(motion.forces(control, np.zeros(motion.axes.shape[1])))


def attainable_contact_acceleration(problem: WholeBodyProblem) -> Array:
    """The contact accelerations closest to the wanted ones that do not contradict each other, shape (k, 3), m/s^2.

    By kinematics alone. Contradictory accelerations make a problem infeasible.
    """
    axes, held, wanted = _held(problem)
    change = axes @ (held @ np.linalg.lstsq(held, wanted, rcond=1e-5)[0] - wanted)
    attainable = problem.wanted + problem.drift
    attainable[problem.stance] += change.reshape(-1, 3)
    return np.asarray(attainable)


def _held(problem: WholeBodyProblem) -> tuple[Array, Array, Array]:
    """Directions in which contacts that stay give force, (3 s, r), the Jacobian along them, the wanted `J qacc`."""
    stays = problem.stance
    each = zip(problem.normals[stays], problem.friction[stays], strict=True)
    axes = _blocks(
        [np.eye(3) if mu > 0.0 else n[:, None] for n, mu in each]
    )  # without friction the normal alone
    stacked = problem.jacobians[stays].reshape(-1, len(problem.bias))
    return axes, axes.T @ stacked, axes.T @ problem.wanted[stays].reshape(-1)


def _blocks(parts: list[Array]) -> Array:
    """The matrix with these on its diagonal; shape (0, 0) without any."""
    from scipy.linalg import block_diag  # here: SciPy takes a while to import

    return np.asarray(block_diag(*parts)) if parts else np.zeros((0, 0))


class _Motion:
    """`qacc = response @ (u, f) + free`, f in the directions `axes`; and the f that lets contacts move as wanted."""

    def __init__(self, problem: WholeBodyProblem) -> None:
        self._problem, nu = problem, len(problem.nominal)
        self.axes, self.held, self._wanted = _held(problem)
        right = np.concatenate([problem.actuation, self.held.T, -problem.bias[:, None]], axis=1)
        solved = np.linalg.solve(problem.inertia, right)
        self.response, self.free = solved[:, :-1], solved[:, -1]
        self.moved, self.missing = self.held @ self.response, self._wanted - self.held @ self.free
        self._by_control, self._by_force = self.moved[:, :nu], self.moved[:, nu:]
        self._inverse = np.linalg.pinv(self._by_force, rcond=_RANK, hermitian=True)

    def forces(self, control: Array, near: Array) -> Array:
        """Those with which contacts move as wanted under a control (nu,), the ones closest to given ones, (r,)."""
        missing = self.missing - self._by_control @ control - self._by_force @ near
        return np.asarray(near + self._inverse @ missing)

    def spread(self, forces: Array) -> Array:
        """At all contacts, shape (k, 3)."""
        every = np.zeros(self._problem.normals.shape)
        every[self._problem.stance] = (self.axes @ forces).reshape(-1, 3)
        return every


def _solve(problem: WholeBodyProblem, sides: Array | None) -> WholeBodySolution:
    """With the sides of pyramids, shape (k, edges, 3), for the contacts that stay and have friction; None: cones."""
    motion, nominal, nu = _Motion(problem), problem.nominal, len(problem.nominal)
    inside = bool(((nominal >= problem.lower) & (nominal <= problem.upper)).all())
    boxed = np.clip(nominal, problem.lower, problem.upper)
    facing = _facing(problem, sides)

    def checked(control: Array, near: Array, status: Status) -> WholeBodySolution | None:
        """The answer of a control and of forces close to given ones, or None if its residuals are too large."""
        forces = motion.spread(motion.forces(control, near))
        answer = _answer(problem, control, forces, status)
        pull = facing @ forces[problem.stance].reshape(-1)
        within = max(answer.cone_error, float(pull.max(initial=0.0))) <= _tolerance(forces)
        return answer if within and answer.contact_error <= _tolerance(problem.wanted) else None

    none = np.zeros(motion.axes.shape[1])
    found = checked(nominal, none, Status.INACTIVE) if inside else None
    if found is not None:
        return found
    y = by_clarabel(_program(problem, motion, facing, sides is None))
    if isinstance(y, Status):
        return _answer(problem, boxed, motion.spread(none), y)
    found = checked(nominal, y[nu:], Status.INACTIVE) if inside else None
    found = found or checked(np.clip(y[:nu], problem.lower, problem.upper), y[nu:], Status.PROJECTED)
    return found or _answer(problem, boxed, motion.spread(none), Status.FAILED)


def _tolerance(sizes: Array) -> float:
    return TOLERANCE * (1.0 + float(np.abs(sizes).max(initial=0.0)))


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


def _facing(problem: WholeBodyProblem, sides: Array | None) -> Array:
    """Half-spaces `facing @ f <= 0` of the forces at contacts that stay, (n, 3 s): sides, or that nothing pulls."""
    each = iter(() if sides is None else sides)
    contacts = zip(problem.normals[problem.stance], problem.friction[problem.stance], strict=True)
    return _blocks([-n[None] if sides is None or mu == 0.0 else next(each) for n, mu in contacts])


class Program(NamedTuple):
    """The program above, with `1/2 y' diag(weights) y + linear' y`."""

    weights: Array  # (n,), positive
    linear: Array  # (n,)
    equal: Array  # E, (e, n)
    values: Array  # e, (e,)
    rows: Array  # G, (k, n)
    limits: Array  # g, (k,); infinite ones are no limit
    cones: Array  # C_i, (m, 3, n)


def _program(problem: WholeBodyProblem, motion: _Motion, facing: Array, exact: bool) -> Program:
    nu, r = len(problem.nominal), motion.axes.shape[1]
    weights = np.concatenate([np.ones(nu), np.full(r, problem.force_weight)])
    linear = np.concatenate([-problem.nominal, np.zeros(r)])
    opening = problem.normals[problem.opening]  # these move away
    rows = -np.einsum("ki,kiv->kv", opening, problem.jacobians[problem.opening])
    limits = -np.einsum("ki,ki->k", opening, problem.wanted[problem.opening])
    box = np.eye(nu, nu + r)
    by_force = np.concatenate([np.zeros((motion.axes.shape[0], nu)), motion.axes], axis=1)
    every = rows @ motion.response, facing @ by_force, box, -box
    most = limits - rows @ motion.free, np.zeros(len(facing)), problem.upper, -problem.lower
    grips = np.flatnonzero(problem.friction[problem.stance] > 0.0) if exact else np.zeros(0, int)
    normals, friction = problem.normals[problem.stance[grips]], problem.friction[problem.stance[grips]]
    frame = np.concatenate([(friction[:, None] * normals)[:, None], tangents(normals)], axis=1)
    cones = frame @ by_force.reshape(-1, 3, nu + r)[grips]
    return Program(
        weights, linear, motion.moved, motion.missing, np.concatenate(every), np.concatenate(most), cones
    )


def by_clarabel(p: Program) -> Array | Status:
    """The y of a program, shape (n,), or why there is none."""
    from scipy import sparse  # here: SciPy takes a while to import

    there = ~np.isinf(p.limits)
    matrix = np.concatenate([p.equal, p.rows[there], -p.cones.reshape(-1, len(p.linear))])
    right = np.concatenate([p.values, p.limits[there], np.zeros(3 * len(p.cones))])
    if not all(np.isfinite(part).all() for part in (p.linear, matrix, right)):
        return Status.FAILED  # clarabel would call it infeasible
    kinds = [clarabel.ZeroConeT(len(p.values)), clarabel.NonnegativeConeT(int(there.sum()))]
    kinds += [clarabel.SecondOrderConeT(3)] * len(p.cones)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _ACCURACY
    hessian = sparse.csc_matrix(np.diag(p.weights))
    solver = clarabel.DefaultSolver(hessian, p.linear, sparse.csc_matrix(matrix), right, kinds, settings)
    solution = solver.solve()
    if solution.status in _NONE_EXISTS:
        return Status.INFEASIBLE
    y = np.asarray(solution.x)
    return y if solution.status in _FOUND and np.isfinite(y).all() else Status.FAILED
