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

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.contact.friction_cone import cone_excess, friction_pyramid, tangents
from safe_wrappers.control.legged.contact_elimination import Elimination, Motion, eliminate, motion_of
from safe_wrappers.control.legged.whole_body_problem import Task, WholeBodyProblem
from safe_wrappers.control.numerics.conic_program import Candidate, Program, by_clarabel, by_daqp
from safe_wrappers.errors import UnknownNameError

__all__ = [
    "Residuals",
    "Task",
    "WholeBodyProblem",
    "WholeBodySolution",
    "WholeBodyStatus",
    "attainable_contact_acceleration",
    "rigid_forces",
    "solve_cone",
    "solve_pyramid",
]

Array = NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest residual that counts as met: relative to 1 plus the size of the forces (N) or accelerations (m/s^2)."""
_INNER_IN_LEAST_VIOLATION = 1e-8
"""What a squared newton of inner force costs there: they would have next to no curvature, and cost digits as well."""
_OBJECTIVE_IN_LEAST_VIOLATION = 1e-3
"""What half the range of a control costs where violations are minimised instead, in squares of their units, at most.

It chooses among what misses about as little. A much smaller one leaves the solvers without digits for the cones: with
1e-6 some answers were half a newton outside.
"""


class WholeBodyStatus(StrEnum):
    """How a solution ended."""

    INACTIVE = "inactive"
    """The nominal control satisfies everything, and nothing else is asked for: `control` is it, bit for bit."""
    SOLVED = "solved"
    """The best control that satisfies everything, residuals checked."""
    INFEASIBLE = "infeasible"
    """No control does. `control` misses contact accelerations and rows least (in squares), box and cones not."""
    FAILED = "failed"
    """No backend gave an answer that passed the check; `control` is inside the box, `forces` may be zeros."""


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
            term included; it ranks answers to one problem. Infinite where there is none.
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
    grips = problem.stance[problem.friction[problem.stance] > 0.0]
    first = None if problem.first_tangents is None else problem.first_tangents[grips]
    pyramids = friction_pyramid(problem.normals[grips], problem.friction[grips], edges, first)
    return _solve(problem, pyramids[:, :-1], solver)  # the sides imply that nothing pulls


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
    motion = motion_of(problem)
    rigid, _ = eliminate(motion)
    y = np.concatenate([control, np.zeros(rigid.size - len(control))])
    return _forces_and_acceleration(problem, motion, rigid, y)


def attainable_contact_acceleration(problem: WholeBodyProblem) -> Array:
    """The contact accelerations closest to the wanted ones that do not contradict each other, shape (k, 3), m/s^2.

    Two points of one rigid foot keep their distance, so that their accelerations cannot be wanted freely; asking for
    what contradicts itself makes a problem without softness infeasible. This is about kinematics alone: whether
    forces and torques allow it is for the solver to say.
    """
    motion = motion_of(problem)
    solution = np.linalg.lstsq(motion.held, motion.wanted, rcond=1e-5)[0]
    change = motion.axes @ (motion.held @ solution - motion.wanted)
    attainable = problem.wanted + problem.drift
    attainable[problem.stance] += change.reshape(-1, 3)
    return np.asarray(attainable)


class _Question(NamedTuple):
    """A program and what its unknowns mean.

    Attributes:
        program: To minimise.
        constant: Of the objective.
        softenable: How many of the program's rows come first that a least violation may break: those of
            accelerations, forces and opening contacts. The others are sides of pyramids.
        elimination: What its unknowns make of the forces.
    """

    program: Program
    constant: float
    softenable: int
    elimination: Elimination


def _question(
    problem: WholeBodyProblem,
    motion: Motion,
    elimination: Elimination,
    sides: Array | None,
    miss_weight: float = 0.0,
) -> _Question:
    nu, n, misses = elimination.controls, elimination.size, elimination.misses
    start, slope = elimination.acceleration(motion)
    weighted = problem.force_weight * elimination.matrix
    hessian = weighted.T @ elimination.matrix
    linear = weighted.T @ elimination.offset
    constant = problem.force_weight * float(elimination.offset @ elimination.offset)
    each = np.arange(nu + misses)
    hessian[each, each] += np.concatenate([problem.weights, np.full(misses, miss_weight)])
    linear[:nu] -= problem.weights * problem.nominal
    constant += float(problem.weights @ problem.nominal**2)
    constant += miss_weight * float(elimination.contradiction @ elimination.contradiction)
    for task in problem.tasks:
        matrix, target = task.jacobian @ slope, task.target - task.drift - task.jacobian @ start
        hessian += task.weight * (matrix.T @ matrix)
        linear -= task.weight * (matrix.T @ target)
        constant += task.weight * float(target @ target)
    rows, limits = _rows(problem, elimination, start, slope)
    softenable = len(limits)
    normals, friction = problem.normals[problem.stance], problem.friction[problem.stance]
    by_contact, force = elimination.matrix.reshape(-1, 3, n), elimination.offset.reshape(-1, 3, 1)
    grips, slides = friction > 0.0, friction == 0.0
    cones = cone_offsets = None
    flat = [(slides, -normals[slides, None])]  # without friction a contact pushes, and that is all
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
    return _Question(program, 0.5 * constant, softenable, elimination)


def _rows(
    problem: WholeBodyProblem, elimination: Elimination, start: Array, slope: Array
) -> tuple[Array, Array]:
    """The acceleration, force and opening rows, in this order."""
    rows, limits = [np.zeros((0, elimination.size))], [np.zeros(0)]
    if problem.acceleration_rows is not None and problem.acceleration_limits is not None:
        rows.append(problem.acceleration_rows @ slope)
        limits.append(problem.acceleration_limits - problem.acceleration_rows @ start)
    if problem.force_rows is not None and problem.force_limits is not None:
        count = len(problem.force_limits)
        part = problem.force_rows.reshape(count, len(problem.normals), 3)[:, problem.stance]
        stance = part.reshape(count, 3 * len(problem.stance))
        rows.append(stance @ elimination.matrix)
        limits.append(problem.force_limits - stance @ elimination.offset)
    if problem.opening.size:
        normals = problem.normals[problem.opening]
        away = np.einsum("ki,kiv->kv", normals, problem.jacobians[problem.opening])
        wanted = np.einsum("ki,ki->k", normals, problem.wanted[problem.opening])
        rows.append(-away @ slope)
        limits.append(away @ start - wanted)
    return np.concatenate(rows), np.concatenate(limits)


def _solve(problem: WholeBodyProblem, sides: Array | None, solver: str) -> WholeBodySolution:
    motion = motion_of(problem)
    rigid, loose = eliminate(motion)
    consistent = float(np.abs(rigid.contradiction).max(initial=0.0)) <= _acceleration_tolerance(problem)
    soft = problem.contact_softness > 0.0
    question = _question(problem, motion, rigid, sides) if consistent else None
    if question is not None and not problem.tasks:
        unchanged = _nominal(problem, motion, question, solver)
        if unchanged is not None:
            return unchanged
    if soft:
        question = _question(problem, motion, loose, sides, 1.0 / problem.contact_softness)
    verdict = "infeasible"
    if question is not None:
        candidate = _ask(question.program, solver)
        if candidate.y is not None:
            found = _checked(problem, motion, question, candidate.y, WholeBodyStatus.SOLVED)
            if found is not None:
                return found
        verdict = "failed" if candidate.y is not None else candidate.verdict
    return _least_violation(problem, motion, loose, sides, solver, verdict)


def _ask(program: Program, solver: str) -> Candidate:
    """One backend, and a second opinion before it is believed that there is no answer."""
    if solver == "daqp":
        candidate = by_daqp(program)
        if candidate.y is not None:
            return candidate
    return by_clarabel(program)


def _nominal(
    problem: WholeBodyProblem, motion: Motion, question: _Question, solver: str
) -> WholeBodySolution | None:
    """The nominal control, if contacts can hold it exactly with some forces that they can give."""
    u, inner = problem.nominal, question.elimination.size - len(problem.nominal)
    if not ((u >= problem.lower) & (u <= problem.upper)).all():
        return None
    y = np.concatenate([u, np.zeros(inner)])
    if inner:
        program = question.program.with_first(u)
        # No second opinion here: where daqp finds no inner forces, the whole problem is solved next.
        found = by_clarabel(program) if solver != "daqp" else by_daqp(program)
        if found.y is None:
            return None
        y[len(u) :] = found.y
    return _checked(problem, motion, question, y, WholeBodyStatus.INACTIVE)


def _acceleration_tolerance(problem: WholeBodyProblem) -> float:
    return TOLERANCE * (1.0 + float(np.abs(problem.wanted).max(initial=0.0)))


def _force_tolerance(forces: Array) -> float:
    return TOLERANCE * (1.0 + float(np.abs(forces).max(initial=0.0)))


def _checked(
    problem: WholeBodyProblem, motion: Motion, question: _Question, y: Array, status: WholeBodyStatus
) -> WholeBodySolution | None:
    """The answer, unless its own residuals say that it is none."""
    nu = len(problem.nominal)
    inside = y.copy()
    inside[:nu] = np.clip(y[:nu], problem.lower, problem.upper)  # a backend's round-off at the box
    answer = _answer(problem, motion, question, inside, status)
    missed = answer.residuals
    force = _force_tolerance(answer.forces)
    exact = problem.contact_softness == 0.0 or status is WholeBodyStatus.INACTIVE
    program, soft = question.program, question.softenable
    over = program.rows @ inside - program.limits
    size = np.abs(program.rows[:soft]) @ np.abs(inside)
    fine = (
        float(np.abs(y[:nu] - inside[:nu]).max(initial=0.0)) <= TOLERANCE
        and missed.cone <= force
        and bool((over[soft:] <= force).all())
        and bool((over[:soft] <= TOLERANCE * (1.0 + size)).all())
        and (not exact or missed.contact <= _acceleration_tolerance(problem))
    )
    return answer if fine else None


def _answer(
    problem: WholeBodyProblem, motion: Motion, question: _Question, y: Array, status: WholeBodyStatus
) -> WholeBodySolution:
    control = problem.nominal if status is WholeBodyStatus.INACTIVE else y[: len(problem.nominal)]
    forces, acceleration = _forces_and_acceleration(problem, motion, question.elimination, y)
    program = question.program
    objective = float(0.5 * y @ program.hessian @ y + program.linear @ y) + question.constant
    missed = _residuals(problem, control, acceleration, forces)
    return WholeBodySolution(control, acceleration, forces, status, missed, objective)


def _forces_and_acceleration(
    problem: WholeBodyProblem, motion: Motion, elimination: Elimination, y: Array
) -> tuple[Array, Array]:
    stance = elimination.offset + elimination.matrix @ y
    forces = np.zeros(problem.normals.shape)
    forces[problem.stance] = stance.reshape(-1, 3)
    return forces, motion.free + motion.by_control @ y[: elimination.controls] + motion.by_force @ stance


def _residuals(problem: WholeBodyProblem, control: Array, acceleration: Array, forces: Array) -> Residuals:
    """From the problem's own matrices, whatever was eliminated on the way to the answer."""
    pushed = np.einsum("kiv,ki->v", problem.jacobians, forces)
    dynamics = problem.inertia @ acceleration + problem.bias - problem.actuation @ control - pushed
    missed = problem.jacobians @ acceleration - problem.wanted
    held = missed[problem.stance]
    along = np.einsum("ki,ki->k", held, problem.normals[problem.stance])
    # Without friction a contact holds along its normal alone.
    held = np.where(problem.friction[problem.stance, None] > 0.0, np.abs(held), np.abs(along)[:, None])
    contact = float(held.max(initial=0.0))
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
    problem: WholeBodyProblem,
    motion: Motion,
    loose: Elimination,
    sides: Array | None,
    solver: str,
    verdict: str,
) -> WholeBodySolution:
    """Minimise the squares of what the contacts' accelerations and the rows miss; box and cones stay hard."""
    softness = problem.contact_softness
    plain = _question(problem, motion, loose, sides, 1.0 / softness if softness > 0.0 else 0.0)
    nu = len(problem.nominal)
    misses = np.arange(nu, nu + loose.misses)
    half = 0.5 * (problem.upper - problem.lower)
    costs = problem.weights * half**2
    share = _OBJECTIVE_IN_LEAST_VIOLATION / max(1.0, float(costs[np.isfinite(costs)].max(initial=0.0)))
    hessian = share * plain.program.hessian
    hessian[misses, misses] += 1.0
    inner = np.arange(nu + loose.misses, loose.size)
    hessian[inner, inner] += _INNER_IN_LEAST_VIOLATION
    softer = plain.program._replace(hessian=hessian, linear=share * plain.program.linear)
    program = softer.softened(plain.softenable)
    status = WholeBodyStatus.INFEASIBLE if verdict == "infeasible" else WholeBodyStatus.FAILED
    for backend in dict.fromkeys((solver, "clarabel")):  # a second opinion where the first misses its cones
        candidate = _ask(program, backend)
        if candidate.y is not None:
            y = candidate.y[: loose.size].copy()
            y[:nu] = np.clip(y[:nu], problem.lower, problem.upper)
            answer = _answer(problem, motion, plain, y, status)
            if answer.residuals.cone <= _force_tolerance(answer.forces):
                return answer
    return _nothing(problem, motion)


def _nothing(problem: WholeBodyProblem, motion: Motion) -> WholeBodySolution:
    """No answer: the nominal control in its box, and contacts without force."""
    control = np.clip(problem.nominal, problem.lower, problem.upper)
    acceleration, forces = motion.free + motion.by_control @ control, np.zeros(problem.normals.shape)
    missed = _residuals(problem, control, acceleration, forces)
    return WholeBodySolution(control, acceleration, forces, WholeBodyStatus.FAILED, missed, np.inf)
