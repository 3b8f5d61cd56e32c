"""Whole-body control: the torques closest to the wanted ones that contacts can answer with forces they can give.

Source: appendix "Floating-base equations of motion" and "Hierarchical whole-body control quadratic program":

    M qacc + h = B u + sum J_k' f_k,

with every f_k in its friction cone, u in the actuators' box, and the contacts' points moving as wanted. With the cone
replaced by a pyramid inside it (`friction_pyramid`) it is a quadratic program (`solve_pyramid`); with the cone itself
it is a second-order cone program (`solve_cone`).

What an answer means: at this instant, for this model, these contacts and this friction, such forces exist. It is no
proof that a foothold carries the load, that the ground has that friction, or that the answer is right a control step
later; and a contact of a simulator that gives way needs no exact contact acceleration.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.conic_program import Candidate, by_clarabel, by_daqp
from safe_wrappers.control.friction_cone import cone_excess, friction_pyramid, tangents
from safe_wrappers.errors import ConfigurationError, UnknownNameError

Array = NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest residual that counts as met: relative to 1 plus the size of the forces (N) or accelerations (m/s^2)."""
_RANK = 1e-9
"""Eigenvalues of the contacts' inverse inertia below this share of the largest are none."""
_OBJECTIVE_IN_LEAST_VIOLATION = 1e-6
"""Share of the objective where violations are minimised instead; it chooses among equals."""
_LEAST_CURVATURE = 1e-10
"""Share of the mean curvature that every direction is given there, so that the answer is unique."""


class WholeBodyStatus(StrEnum):
    """How a solution ended."""

    INACTIVE = "inactive"
    """The nominal control satisfies everything, and nothing else is asked for: `control` is it, bit for bit."""
    SOLVED = "solved"
    """The best control that satisfies everything, residuals checked."""
    INFEASIBLE = "infeasible"
    """No control does; `control` violates contact accelerations and rows least, box and cones not at all."""
    FAILED = "failed"
    """No backend gave an answer that passed the check; `control` is only inside the box."""


@dataclass(frozen=True, eq=False)
class Task:
    """Something to accelerate: `weight * |jacobian @ qacc + drift - target|^2` is added to the objective.

    Attributes:
        jacobian: Shape (r, nv).
        drift: `dJ/dt qvel`, shape (r,).
        target: Wanted acceleration, shape (r,).
        weight: At least 0.
    """

    jacobian: Array
    drift: Array
    target: Array
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class WholeBodyProblem:
    """One instant of a robot in contact.

    Attributes:
        inertia: M, shape (nv, nv), positive definite.
        bias: h, shape (nv,): Coriolis, centrifugal and gravity forces minus passive ones, on the left-hand side.
        actuation: B, shape (nv, nu): generalised force per control.
        jacobians: J_k of the contact points, shape (k, 3, nv); k may be 0.
        drift: `dJ/dt qvel` of the contact points, shape (k, 3), m/s^2.
        normals: Unit normals, pointing at what the forces push, shape (k, 3).
        friction: Coefficients, at least 0, shape (k,).
        lower: Smallest control, shape (nu,).
        upper: Largest control, shape (nu,).
        nominal: The control to stay close to, shape (nu,).
        contact_acceleration: Wanted of the contact points, shape (k, 3), m/s^2; None is none: the points stay.
        control_weight: Of the squared distance from the nominal, positive, a number or shape (nu,).
        force_weight: Of the squared contact forces, positive, per N^2. It chooses among forces that do the same;
            a large one moves the control away from the nominal.
        contact_softness: 0 asks for the wanted contact accelerations exactly. Larger: a miss r (m/s^2) costs
            `r^2 / contact_softness` instead; a nominal that needs none is still left alone.
        breaking: Contacts that are to open, shape (k,): their force is 0 and their acceleration along the normal is at
            least the wanted one. None is none of them.
        first_tangents: Direction of each pyramid's first edge, shape (k, 3); None chooses.
        tasks: See `Task`; with any, no control is `inactive`.
        acceleration_rows: G in `G qacc <= g`, shape (m, nv) (`predicted_position_rows` makes some).
        acceleration_limits: g, shape (m,).
        force_rows: R in `R f <= r`, f the stacked contact forces, shape (m', 3 k) (`support_rows` makes some).
        force_limits: r, shape (m',).
    """

    inertia: Array
    bias: Array
    actuation: Array
    jacobians: Array
    drift: Array
    normals: Array
    friction: Array
    lower: Array
    upper: Array
    nominal: Array
    contact_acceleration: Array | None = None
    control_weight: Array | float = 1.0
    force_weight: float = 1e-8
    contact_softness: float = 0.0
    breaking: NDArray[np.bool_] | None = None
    first_tangents: Array | None = None
    tasks: Sequence[Task] = ()
    acceleration_rows: Array | None = None
    acceleration_limits: Array | None = None
    force_rows: Array | None = None
    force_limits: Array | None = None
    stance: NDArray[np.intp] = field(init=False)
    """Indices of the contacts that are to stay."""
    opening: NDArray[np.intp] = field(init=False)
    """Indices of the contacts that are to open."""
    weights: Array = field(init=False)
    """`control_weight` as an array, shape (nu,)."""
    wanted: Array = field(init=False)
    """`contact_acceleration`, or zeros, minus the drift: what `J qacc` is to be, shape (k, 3)."""

    def __post_init__(self) -> None:
        nv, nu, k = len(self.bias), len(self.nominal), len(self.normals)
        limits = 0 if self.acceleration_limits is None else len(self.acceleration_limits)
        force_limits = 0 if self.force_limits is None else len(self.force_limits)
        for name, shape in (
            ("inertia", (nv, nv)),
            ("bias", (nv,)),
            ("actuation", (nv, nu)),
            ("jacobians", (k, 3, nv)),
            ("drift", (k, 3)),
            ("normals", (k, 3)),
            ("friction", (k,)),
            ("lower", (nu,)),
            ("upper", (nu,)),
            ("nominal", (nu,)),
            ("contact_acceleration", (k, 3)),
            ("breaking", (k,)),
            ("first_tangents", (k, 3)),
            ("acceleration_rows", (limits, nv)),
            ("acceleration_limits", (limits,)),
            ("force_rows", (force_limits, 3 * k)),
            ("force_limits", (force_limits,)),
        ):
            value = getattr(self, name)
            if value is None:
                continue
            if value.shape != shape:
                raise ConfigurationError(f"expected {name} of shape {shape}, got {value.shape}")
            if name not in ("lower", "upper") and not np.isfinite(value).all():
                raise ConfigurationError(f"{name} must be finite, got {value}")
        for task in self.tasks:
            rows = len(task.target)
            if task.jacobian.shape != (rows, nv) or task.drift.shape != (rows,):
                raise ConfigurationError(
                    f"expected a task's jacobian (r, {nv}), drift (r,) and target (r,), got "
                    f"{task.jacobian.shape}, {task.drift.shape} and {task.target.shape}"
                )
            if not (0.0 <= task.weight < np.inf):
                raise ConfigurationError(f"a task's weight must be 0 or more and finite, got {task.weight}")
            if not all(np.isfinite(a).all() for a in (task.jacobian, task.drift, task.target)):
                raise ConfigurationError("a task must be finite")
        for rows_name, limits_name in (
            ("acceleration_rows", "acceleration_limits"),
            ("force_rows", "force_limits"),
        ):
            if (getattr(self, rows_name) is None) != (getattr(self, limits_name) is None):
                raise ConfigurationError(f"{rows_name} and {limits_name} come together")
        if not (self.lower <= self.upper).all():
            raise ConfigurationError(f"lower must not exceed upper, got {self.lower} and {self.upper}")
        if not (self.friction >= 0.0).all():
            raise ConfigurationError(f"friction must be 0 or more, got {self.friction}")
        weights = np.broadcast_to(np.asarray(self.control_weight, dtype=np.float64), (nu,))
        if not (np.isfinite(weights).all() and (weights > 0.0).all()):
            raise ConfigurationError(f"control_weight must be positive and finite, got {self.control_weight}")
        if not 0.0 < self.force_weight < np.inf:
            raise ConfigurationError(f"force_weight must be positive and finite, got {self.force_weight}")
        if not 0.0 <= self.contact_softness < np.inf:
            raise ConfigurationError(
                f"contact_softness must be 0 or more and finite, got {self.contact_softness}"
            )
        opens = np.zeros(k, bool) if self.breaking is None else np.asarray(self.breaking, bool)
        acceleration = 0.0 if self.contact_acceleration is None else self.contact_acceleration
        object.__setattr__(self, "stance", np.flatnonzero(~opens))
        object.__setattr__(self, "opening", np.flatnonzero(opens))
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "wanted", acceleration - self.drift)


class Residuals(NamedTuple):
    """By how much an answer misses what was asked, each at least 0; evaluated from the answer, not by a solver.

    Attributes:
        dynamics: Largest entry of `M qacc + h - B u - J' f`, N or N m.
        contact: Largest miss of a contact's wanted acceleration, m/s^2 (of an opening one: what it falls short).
        cone: Largest miss of a friction cone, N; of the exact one, also where a pyramid was used.
        bounds: Farthest that the control is outside the box.
        rows: Largest excess over a limit of `acceleration_rows` or `force_rows`, in their units.
    """

    dynamics: float
    contact: float
    cone: float
    bounds: float
    rows: float


class WholeBodySolution(NamedTuple):
    """An answer that has been checked.

    Attributes:
        control: Shape (nu,), finite and inside the box.
        acceleration: qacc under it and the forces, shape (nv,).
        forces: At the contacts, shape (k, 3), N, each inside its cone (and pyramid).
        status: See `WholeBodyStatus`; compares equal to its string.
        residuals: See `Residuals`.
        objective: Half the weighted squares that were minimised, of a problem with `contact_softness` its contact
            term included; it ranks answers to one problem.
    """

    control: Array
    acceleration: Array
    forces: Array
    status: WholeBodyStatus
    residuals: Residuals
    objective: float


def solve_pyramid(problem: WholeBodyProblem, edges: int = 4, solver: str = "daqp") -> WholeBodySolution:
    """Solve with friction pyramids: a quadratic program, conservative.

    Args:
        problem: The instant.
        edges: Of each pyramid, at least 3.
        solver: "daqp" (an active set: the fast one) or "clarabel" (interior points).

    Raises:
        ConfigurationError: Too few edges.
        UnknownNameError: No such solver.
    """
    if solver not in ("daqp", "clarabel"):
        raise UnknownNameError(f"solver {solver!r} is not one of: daqp, clarabel")
    kept = problem.stance
    first = None if problem.first_tangents is None else problem.first_tangents[kept]
    sides = friction_pyramid(problem.normals[kept], problem.friction[kept], edges, first)
    if (problem.friction[kept] > 0.0).all():
        sides = sides[:, :-1]  # they imply that nothing pulls
    return _solve(problem, sides, solver)


def solve_cone(problem: WholeBodyProblem) -> WholeBodySolution:
    """Solve with the exact friction cones: a second-order cone program, by clarabel."""
    return _solve(problem, None, "clarabel")


def rigid_forces(problem: WholeBodyProblem, control: Array) -> tuple[Array, Array]:
    """The contact forces that keep the contacts as wanted under a control, whether ground can give them or not.

    Where the contacts are more than the motion needs, the smallest such forces; others may share the load better.
    What contradicts itself is met as closely as it can be.

    Args:
        problem: The instant.
        control: Shape (nu,).

    Returns:
        Forces, shape (k, 3), N, 0 at contacts that are to open, and the acceleration qacc, shape (nv,).
    """
    motion = _motion(problem)
    reduced = _rigid(problem, motion)
    y = np.concatenate([control, np.zeros(reduced.size - len(control))])
    return reduced.forces(y, problem), reduced.acceleration(y, motion, problem)


def attainable_contact_acceleration(problem: WholeBodyProblem) -> Array:
    """The contact accelerations closest to the wanted ones that do not contradict each other, shape (k, 3), m/s^2.

    Two points of one rigid foot keep their distance, so that their accelerations cannot be wanted freely; asking for
    what contradicts itself makes a hard problem infeasible. This is about kinematics alone: whether forces and torques
    allow it is for the solver to say.
    """
    nv = len(problem.bias)
    stacked = problem.jacobians.reshape(-1, nv)
    wanted = problem.wanted.reshape(-1)
    solution = np.linalg.lstsq(stacked, wanted, rcond=_RANK**0.5)[0]
    return np.asarray((stacked @ solution).reshape(-1, 3) + problem.drift)


class _Motion(NamedTuple):
    """qacc = free + by_control u + by_force f, f the stacked forces of the stance contacts."""

    free: Array
    by_control: Array
    by_force: Array
    stacked: Array


def _motion(problem: WholeBodyProblem) -> _Motion:
    nv, nu = problem.actuation.shape
    stacked = problem.jacobians[problem.stance].reshape(-1, nv)
    right = np.concatenate([problem.actuation, stacked.T, problem.bias[:, None]], axis=1)
    solved = np.linalg.solve(problem.inertia, right)
    return _Motion(-solved[:, -1], solved[:, :nu], solved[:, nu:-1], stacked)


class _Reduced(NamedTuple):
    """Forces of the stance contacts as an affine function of the unknowns y = (control, rest).

    Attributes:
        size: Number of unknowns.
        offset: Shape (3 s,).
        matrix: Shape (3 s, size).
        contradiction: By how much the wanted contact accelerations contradict each other, m/s^2.
    """

    size: int
    offset: Array
    matrix: Array
    contradiction: float

    def stance_forces(self, y: Array) -> Array:
        return self.offset + self.matrix @ y[: self.size]

    def forces(self, y: Array, problem: WholeBodyProblem) -> Array:
        found = np.zeros(problem.normals.shape)
        found[problem.stance] = self.stance_forces(y).reshape(-1, 3)
        return found

    def acceleration(self, y: Array, motion: _Motion, problem: WholeBodyProblem) -> Array:
        control = y[: len(problem.nominal)]
        return np.asarray(motion.free + motion.by_control @ control + motion.by_force @ self.stance_forces(y))


def _rigid(problem: WholeBodyProblem, motion: _Motion) -> _Reduced:
    """Contacts move as wanted: that settles the forces but for those inside the robot, which do no motion."""
    nu = len(problem.nominal)
    compliance = motion.stacked @ motion.by_force
    wanted = problem.wanted[problem.stance].reshape(-1) - motion.stacked @ motion.free
    if not wanted.size:
        return _Reduced(nu, wanted, np.zeros((0, nu)), 0.0)
    values, vectors = np.linalg.eigh(0.5 * (compliance + compliance.T))
    counts = values > _RANK * max(float(values[-1]), 1e-300)
    held, idle = vectors[:, counts], vectors[:, ~counts]
    inverse = (held / values[counts]) @ held.T
    # Inner forces make no acceleration, so no control reaches what is wanted along them.
    contradiction = float(np.abs(idle @ (idle.T @ wanted)).max()) if idle.size else 0.0
    matrix = np.concatenate([-inverse @ (motion.stacked @ motion.by_control), idle], axis=1)
    return _Reduced(nu + idle.shape[1], inverse @ wanted, matrix, contradiction)


def _loose(problem: WholeBodyProblem) -> _Reduced:
    """Any forces: the contacts' accelerations are a matter of the objective."""
    nu, forces = len(problem.nominal), 3 * len(problem.stance)
    matrix = np.concatenate([np.zeros((forces, nu)), _identity(forces)], axis=1)
    return _Reduced(nu + forces, np.zeros(forces), matrix, 0.0)


class _Program(NamedTuple):
    """The problem in the unknowns y.

    Attributes:
        hessian: Shape (n, n).
        linear: Shape (n,).
        constant: Of the objective.
        rows: Shape (m, n): what may be softened, in this order: acceleration, force and opening rows.
        limits: Shape (m,).
        sides: Of the pyramids, shape (m', n); none with exact cones.
        side_limits: Shape (m',).
        cones: Shape (s, 3, n), or None with pyramids.
        cone_offsets: Shape (s, 3).
    """

    hessian: Array
    linear: Array
    constant: float
    rows: Array
    limits: Array
    sides: Array
    side_limits: Array
    cones: Array | None
    cone_offsets: Array | None


def _program(
    problem: WholeBodyProblem, motion: _Motion, reduced: _Reduced, sides: Array | None, softness: float
) -> _Program:
    nu, n = len(problem.nominal), reduced.size
    by_y = motion.by_force @ reduced.matrix
    by_y[:, :nu] += motion.by_control
    start = motion.free + motion.by_force @ reduced.offset
    weighted = problem.force_weight * reduced.matrix
    hessian = weighted.T @ reduced.matrix
    linear = weighted.T @ reduced.offset
    constant = problem.force_weight * float(reduced.offset @ reduced.offset)
    diagonal = np.arange(nu)
    hessian[diagonal, diagonal] += problem.weights
    linear[:nu] -= problem.weights * problem.nominal
    constant += float(problem.weights @ problem.nominal**2)
    squares = [
        (task.weight, task.jacobian @ by_y, task.target - task.drift - task.jacobian @ start)
        for task in problem.tasks
    ]
    if softness > 0.0:
        wanted = problem.wanted[problem.stance].reshape(-1)
        squares.append((1.0 / softness, motion.stacked @ by_y, wanted - motion.stacked @ start))
    for weight, matrix, target in squares:
        hessian += weight * (matrix.T @ matrix)
        linear -= weight * (matrix.T @ target)
        constant += weight * float(target @ target)
    rows, limits = _rows(problem, reduced, by_y, start)
    if sides is None:
        cones, cone_offsets = _cones(problem, reduced)
        flat, flat_limits = np.zeros((0, n)), np.zeros(0)
    else:
        cones = cone_offsets = None
        by_contact = reduced.matrix.reshape(-1, 3, n)
        flat = (sides @ by_contact).reshape(-1, n)
        flat_limits = -(sides @ reduced.offset.reshape(-1, 3, 1)).reshape(-1)
    return _Program(hessian, linear, 0.5 * constant, rows, limits, flat, flat_limits, cones, cone_offsets)


def _rows(problem: WholeBodyProblem, reduced: _Reduced, by_y: Array, start: Array) -> tuple[Array, Array]:
    """The acceleration, force and opening rows, in this order."""
    rows, limits = [np.zeros((0, reduced.size))], [np.zeros(0)]
    if problem.acceleration_rows is not None and problem.acceleration_limits is not None:
        rows.append(problem.acceleration_rows @ by_y)
        limits.append(problem.acceleration_limits - problem.acceleration_rows @ start)
    if problem.force_rows is not None and problem.force_limits is not None:
        part = problem.force_rows.reshape(-1, len(problem.normals), 3)[:, problem.stance]
        stance = part.reshape(-1, 3 * len(problem.stance))
        rows.append(stance @ reduced.matrix)
        limits.append(problem.force_limits - stance @ reduced.offset)
    if problem.opening.size:
        normals = problem.normals[problem.opening]
        away = np.einsum("ki,kiv->kv", normals, problem.jacobians[problem.opening])
        wanted = np.einsum("ki,ki->k", normals, problem.wanted[problem.opening])
        rows.append(-away @ by_y)
        limits.append(away @ start - wanted)
    return np.concatenate(rows), np.concatenate(limits)


def _cones(problem: WholeBodyProblem, reduced: _Reduced) -> tuple[Array, Array]:
    """(mu f_n, f_t) of each stance contact as an affine function of y."""
    normals, friction = problem.normals[problem.stance], problem.friction[problem.stance]
    frame = np.concatenate([friction[:, None, None] * normals[:, None], tangents(normals)], axis=1)
    offsets = (frame @ reduced.offset.reshape(-1, 3, 1))[:, :, 0]
    return frame @ reduced.matrix.reshape(-1, 3, reduced.size), offsets


def _solve(problem: WholeBodyProblem, sides: Array | None, solver: str) -> WholeBodySolution:
    motion = _motion(problem)
    rigid = _rigid(problem, motion)
    soft = problem.contact_softness
    if not problem.tasks:
        unchanged = _nominal(problem, motion, rigid, sides, solver)
        if unchanged is not None:
            return unchanged
    reduced = _loose(problem) if soft > 0.0 else rigid
    program = _program(problem, motion, reduced, sides, soft)
    verdict = "infeasible"
    if soft > 0.0 or _contradiction_is_rounding(rigid, problem):
        candidate = _backend(problem, program, solver)
        if candidate.verdict != "solved" and solver == "daqp":
            candidate = _backend(problem, program, "clarabel")  # a second opinion, before it is believed
        if candidate.y is not None:
            found = _checked(problem, motion, reduced, program, candidate.y, WholeBodyStatus.SOLVED)
            if found is not None:
                return found
        verdict = candidate.verdict
    return _least_violation(problem, motion, sides, solver, verdict)


def _nominal(
    problem: WholeBodyProblem, motion: _Motion, rigid: _Reduced, sides: Array | None, solver: str
) -> WholeBodySolution | None:
    """The nominal control, if contacts can hold it exactly with some forces that they can give."""
    u = problem.nominal
    inside = bool(((u >= problem.lower) & (u <= problem.upper)).all())
    if not inside or not _contradiction_is_rounding(rigid, problem):
        return None
    program = _program(problem, motion, rigid, sides, 0.0)
    nu, inner = len(u), rigid.size - len(u)
    y = np.concatenate([u, np.zeros(inner)])
    if inner:
        cones, offsets = program.cones, program.cone_offsets
        if cones is not None and offsets is not None:
            cones, offsets = cones[:, :, nu:], offsets + cones[:, :, :nu] @ u
        rows = np.concatenate([program.rows, program.sides])
        limits = np.concatenate([program.limits, program.side_limits]) - rows[:, :nu] @ u
        free = np.full(inner, np.inf)
        if cones is None and solver == "daqp":
            found = by_daqp(_identity(inner), np.zeros(inner), rows[:, nu:], limits, -free, free)
        else:
            found = by_clarabel(
                np.eye(inner), np.zeros(inner), rows[:, nu:], limits, -free, free, cones, offsets
            )
        if found.y is None:
            return None
        y[nu:] = found.y
    return _checked(problem, motion, rigid, program, y, WholeBodyStatus.INACTIVE)


def _backend(problem: WholeBodyProblem, program: _Program, solver: str) -> Candidate:
    rest = np.full(program.linear.size - len(problem.nominal), np.inf)
    lower, upper = np.concatenate([problem.lower, -rest]), np.concatenate([problem.upper, rest])
    rows = np.concatenate([program.rows, program.sides])
    limits = np.concatenate([program.limits, program.side_limits])
    if solver == "daqp":
        return by_daqp(program.hessian, program.linear, rows, limits, lower, upper)
    return by_clarabel(
        program.hessian, program.linear, rows, limits, lower, upper, program.cones, program.cone_offsets
    )


def _checked(
    problem: WholeBodyProblem,
    motion: _Motion,
    reduced: _Reduced,
    program: _Program,
    y: Array,
    status: WholeBodyStatus,
) -> WholeBodySolution | None:
    """The answer, unless its own residuals say that it is none."""
    nu = len(problem.nominal)
    inside = y.copy()
    inside[:nu] = np.clip(y[:nu], problem.lower, problem.upper)  # a backend's round-off at the box
    answer = _answer(problem, motion, reduced, program, inside, status)
    missed = answer.residuals
    force = TOLERANCE * (1.0 + float(np.abs(answer.forces).max(initial=0.0)))
    acceleration = TOLERANCE * (1.0 + float(np.abs(problem.wanted).max(initial=0.0)))
    exact = problem.contact_softness == 0.0 or status is WholeBodyStatus.INACTIVE
    over = program.sides @ inside[: reduced.size] - program.side_limits
    size = np.abs(program.rows).sum(axis=1) * np.abs(inside[: reduced.size]).max(initial=1.0)
    rows = program.rows @ inside[: reduced.size] - program.limits <= TOLERANCE * (1.0 + size)
    fine = (
        float(np.abs(y[:nu] - inside[:nu]).max(initial=0.0)) <= TOLERANCE
        and missed.cone <= force
        and float(over.max(initial=0.0)) <= force
        and bool(rows.all())
        and (not exact or missed.contact <= acceleration)
    )
    return answer if fine else None


def _answer(
    problem: WholeBodyProblem,
    motion: _Motion,
    reduced: _Reduced,
    program: _Program,
    y: Array,
    status: WholeBodyStatus,
) -> WholeBodySolution:
    control = problem.nominal if status is WholeBodyStatus.INACTIVE else y[: len(problem.nominal)]
    forces = reduced.forces(y, problem)
    acceleration = reduced.acceleration(y, motion, problem)
    z = y[: reduced.size]
    objective = float(0.5 * z @ program.hessian @ z + program.linear @ z) + program.constant
    missed = _residuals(problem, control, acceleration, forces)
    return WholeBodySolution(control, acceleration, forces, status, missed, objective)


def _residuals(problem: WholeBodyProblem, control: Array, acceleration: Array, forces: Array) -> Residuals:
    """From the problem's own matrices, whatever was eliminated on the way to the answer."""
    pushed = np.einsum("kiv,ki->v", problem.jacobians, forces)
    dynamics = problem.inertia @ acceleration + problem.bias - problem.actuation @ control - pushed
    missed = problem.jacobians @ acceleration - problem.wanted
    contact = float(np.abs(missed[problem.stance]).max(initial=0.0))
    if problem.opening.size:
        normals = problem.normals[problem.opening]
        short = -np.einsum("ki,ki->k", normals, missed[problem.opening])
        contact = max(contact, float(short.max()))
    cone = (
        float(cone_excess(forces, problem.normals, problem.friction).max(initial=0.0)) if len(forces) else 0.0
    )
    outside = np.maximum(problem.lower - control, control - problem.upper)
    rows = 0.0
    if problem.acceleration_rows is not None and problem.acceleration_limits is not None:
        excess = problem.acceleration_rows @ acceleration - problem.acceleration_limits
        rows = float(excess.max(initial=0.0))
    if problem.force_rows is not None and problem.force_limits is not None:
        excess = problem.force_rows @ forces.reshape(-1) - problem.force_limits
        rows = max(rows, float(excess.max(initial=0.0)))
    return Residuals(
        float(np.abs(dynamics).max(initial=0.0)), contact, cone, float(outside.max(initial=0.0)), rows
    )


def _least_violation(
    problem: WholeBodyProblem, motion: _Motion, sides: Array | None, solver: str, verdict: str
) -> WholeBodySolution:
    """Minimise the squares of what the contacts' accelerations and the rows miss; box and cones stay hard."""
    loose = _loose(problem)
    plain = _program(problem, motion, loose, sides, problem.contact_softness)
    by_y = np.concatenate([motion.by_control, motion.by_force], axis=1)
    matrix = motion.stacked @ by_y
    target = problem.wanted[problem.stance].reshape(-1) - motion.stacked @ motion.free
    n, m = loose.size, len(plain.limits)
    hessian, linear = np.zeros((n + m, n + m)), np.zeros(n + m)
    hessian[:n, :n] = matrix.T @ matrix + _OBJECTIVE_IN_LEAST_VIOLATION * plain.hessian
    linear[:n] = _OBJECTIVE_IN_LEAST_VIOLATION * plain.linear - matrix.T @ target
    hessian[n:, n:] = np.eye(m)
    hessian[:n, :n] += _LEAST_CURVATURE * np.trace(hessian[:n, :n]) / n * np.eye(n)
    slack = plain._replace(
        hessian=hessian,
        linear=linear,
        rows=np.concatenate([plain.rows, -np.eye(m)], axis=1),
        sides=np.concatenate([plain.sides, np.zeros((len(plain.sides), m))], axis=1),
        cones=None
        if plain.cones is None
        else np.concatenate([plain.cones, np.zeros((*plain.cones.shape[:2], m))], axis=2),
    )
    candidate = _backend(problem, slack, solver)
    if candidate.y is None and solver == "daqp":
        candidate = _backend(problem, slack, "clarabel")
    nu = len(problem.nominal)
    if candidate.y is None:
        y = np.zeros(n)
        y[:nu] = np.clip(problem.nominal, problem.lower, problem.upper)
        return _answer(problem, motion, loose, plain, y, WholeBodyStatus.FAILED)
    y = candidate.y[:n].copy()
    y[:nu] = np.clip(y[:nu], problem.lower, problem.upper)
    status = WholeBodyStatus.INFEASIBLE if verdict == "infeasible" else WholeBodyStatus.FAILED
    return _answer(problem, motion, loose, plain, y, status)


def _contradiction_is_rounding(rigid: _Reduced, problem: WholeBodyProblem) -> bool:
    return rigid.contradiction <= TOLERANCE * (1.0 + float(np.abs(problem.wanted).max(initial=0.0)))


@functools.cache
def _identity(n: int) -> Array:
    return np.eye(n)
