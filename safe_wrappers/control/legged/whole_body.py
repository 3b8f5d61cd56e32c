"""Whole-body control: the torques closest to the nominal ones for which feasible contact forces exist.

Source: appendix "Floating-base equations of motion" and "Hierarchical whole-body control quadratic program":

    M qacc + h = B u + sum J_k' f_k,

with every f_k in its friction cone, u in the actuators' box, and the contacts' points moving as wanted. A solution
says that such forces exist at this instant, not that the same holds a control step later.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.contact.friction_cone import cone_excess, friction_pyramid
from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem
from safe_wrappers.control.legged.whole_body_program import (
    Candidate,
    Elimination,
    Motion,
    Program,
    ReducedProgram,
    by_clarabel,
    by_daqp,
    eliminate,
    motion_of,
    reduced_program,
)

TOLERANCE = 1e-6
"""Largest residual that counts as met: relative to 1 plus the size of the forces (N) or accelerations (m/s^2)."""


class WholeBodyStatus(StrEnum):
    """Outcome of a solution."""

    INACTIVE = "inactive"
    """The nominal control satisfies everything: `control` equals it, bit for bit."""
    SOLVED = "solved"
    """The best control that satisfies everything, residuals checked."""
    INFEASIBLE = "infeasible"
    """No control does."""
    FAILED = "failed"
    """No solver gave an answer that passed the check."""


class Residuals(NamedTuple):
    """Constraint violations of an answer, each at least 0, evaluated from the answer itself.

    Attributes:
        contact: Largest error of a contact's acceleration, m/s^2 (of an opening one: its shortfall).
        cone: Largest violation of an exact friction cone, N, also where a pyramid was used.
    """

    contact: float
    cone: float


class WholeBodySolution(NamedTuple):
    """A checked answer.

    Attributes:
        control: Shape (nu,), finite and inside the box; without an answer the nominal one, clipped to it.
        acceleration: qacc under it and the forces, shape (nv,).
        forces: At the contacts, shape (k, 3), N, each inside its cone (and pyramid); zeros without an answer.
        status: Compares equal to its string.
        residuals: See `Residuals`.
    """

    control: Array
    acceleration: Array
    forces: Array
    status: WholeBodyStatus
    residuals: Residuals


def solve_pyramid(problem: WholeBodyProblem, edges: int = 4) -> WholeBodySolution:
    """Solve with friction pyramids of so many edges, at least 3: a quadratic program, conservative, by daqp."""
    grips = problem.stance[problem.friction[problem.stance] > 0.0]
    first = None if problem.first_tangents is None else problem.first_tangents[grips]
    pyramids = friction_pyramid(problem.normals[grips], problem.friction[grips], edges, first)
    return _solve(problem, pyramids[:, :-1])  # the sides imply that nothing pulls


def solve_cone(problem: WholeBodyProblem) -> WholeBodySolution:
    """Solve with the exact friction cones: a second-order cone program, by clarabel."""
    return _solve(problem, None)


def rigid_forces(problem: WholeBodyProblem, control: Array) -> tuple[Array, Array]:
    """The contact forces that give the wanted contact accelerations under a control (nu,), feasible or not.

    Forces (k, 3), N, the smallest ones where they are not unique and 0 at contacts that are to open, and qacc (nv,).
    Contradictory accelerations are met as closely as possible.
    """
    motion = motion_of(problem)
    rigid = eliminate(motion)
    y = np.concatenate([control, np.zeros(rigid.size - len(control))])
    return _forces_and_acceleration(problem, motion, rigid, y)


def attainable_contact_acceleration(problem: WholeBodyProblem) -> Array:
    """The contact accelerations closest to the wanted ones that do not contradict each other, shape (k, 3), m/s^2.

    By kinematics alone. Contradictory accelerations make a problem infeasible.
    """
    motion = motion_of(problem)
    solution = np.linalg.lstsq(motion.held, motion.wanted, rcond=1e-5)[0]
    change = motion.axes @ (motion.held @ solution - motion.wanted)
    attainable = problem.wanted + problem.drift
    attainable[problem.stance] += change.reshape(-1, 3)
    return np.asarray(attainable)


def _solve(problem: WholeBodyProblem, sides: Array | None) -> WholeBodySolution:
    motion = motion_of(problem)
    rigid = eliminate(motion)
    consistent = float(np.abs(rigid.contradiction).max(initial=0.0)) <= _tolerance(problem.wanted)
    reduced = reduced_program(problem, motion, rigid, sides) if consistent else None
    status = WholeBodyStatus.INFEASIBLE
    if reduced is not None:
        nu = len(problem.nominal)
        unchanged = _nominal(problem, motion, reduced, np.zeros(rigid.size - nu))
        if unchanged is not None:
            return unchanged
        candidate = _ask(reduced.program)
        if candidate.y is not None:
            unchanged = _nominal(problem, motion, reduced, candidate.y[nu:])
            found = unchanged or _checked(problem, motion, reduced, candidate.y, WholeBodyStatus.SOLVED)
            if found is not None:
                return found
        if candidate.verdict != "infeasible":
            status = WholeBodyStatus.FAILED
    # Nothing passed: the nominal control clipped to its box, contacts without force.
    control = np.clip(problem.nominal, problem.lower, problem.upper)
    acceleration, forces = motion.free + motion.by_control @ control, np.zeros(problem.normals.shape)
    missed = _residuals(problem, acceleration, forces)
    return WholeBodySolution(control, acceleration, forces, status, missed)


def _ask(program: Program) -> Candidate:
    """Daqp where there are no cones; clarabel as well before infeasibility is accepted."""
    if program.cones is None:
        candidate = by_daqp(program)
        if candidate.y is not None:
            return candidate
    return by_clarabel(program)


def _nominal(
    problem: WholeBodyProblem, motion: Motion, reduced: ReducedProgram, inner: Array
) -> WholeBodySolution | None:
    """The nominal control, if contacts can hold it exactly with these inner forces."""
    u = problem.nominal
    if not ((u >= problem.lower) & (u <= problem.upper)).all():
        return None
    return _checked(problem, motion, reduced, np.concatenate([u, inner]), WholeBodyStatus.INACTIVE)


def _tolerance(sizes: Array) -> float:
    return TOLERANCE * (1.0 + float(np.abs(sizes).max(initial=0.0)))


def _checked(
    problem: WholeBodyProblem, motion: Motion, reduced: ReducedProgram, y: Array, status: WholeBodyStatus
) -> WholeBodySolution | None:
    """The answer, or None if its residuals are too large."""
    nu = len(problem.nominal)
    inside = y.copy()
    inside[:nu] = np.clip(y[:nu], problem.lower, problem.upper)  # a solver's round-off at the box
    answer = _answer(problem, motion, reduced, inside, status)
    missed = answer.residuals
    force = _tolerance(answer.forces)
    program, soft = reduced.program, reduced.accelerations
    over = program.rows @ inside - program.limits
    size = np.abs(program.rows[:soft]) @ np.abs(inside)
    fine = (
        float(np.abs(y[:nu] - inside[:nu]).max(initial=0.0)) <= TOLERANCE
        and missed.cone <= force
        and bool((over[soft:] <= force).all())
        and bool((over[:soft] <= TOLERANCE * (1.0 + size)).all())
        and missed.contact <= _tolerance(problem.wanted)
    )
    return answer if fine else None


def _answer(
    problem: WholeBodyProblem, motion: Motion, reduced: ReducedProgram, y: Array, status: WholeBodyStatus
) -> WholeBodySolution:
    control = problem.nominal if status is WholeBodyStatus.INACTIVE else y[: len(problem.nominal)]
    forces, acceleration = _forces_and_acceleration(problem, motion, reduced.elimination, y)
    missed = _residuals(problem, acceleration, forces)
    return WholeBodySolution(control, acceleration, forces, status, missed)


def _forces_and_acceleration(
    problem: WholeBodyProblem, motion: Motion, elimination: Elimination, y: Array
) -> tuple[Array, Array]:
    stance = elimination.offset + elimination.matrix @ y
    forces = np.zeros(problem.normals.shape)
    forces[problem.stance] = stance.reshape(-1, 3)
    return forces, motion.free + motion.by_control @ y[: elimination.controls] + motion.by_force @ stance


def _residuals(problem: WholeBodyProblem, acceleration: Array, forces: Array) -> Residuals:
    """From the problem's own matrices, independent of the elimination."""
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
    cone = float(cone_excess(forces, problem.normals, problem.friction).max(initial=0.0))
    return Residuals(contact, cone)
