"""The whole-body problem as a program in the control, the missed contact accelerations and the inner forces."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.contact.friction_cone import tangents
from safe_wrappers.control.legged.contact_elimination import Elimination, Motion
from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem
from safe_wrappers.control.numerics.conic_program import Program

Array = NDArray[np.float64]


class ReducedProgram(NamedTuple):
    """A program and the meaning of its unknowns.

    Attributes:
        program: The program.
        constant: To be added to its objective.
        softenable: Number of leading rows that a least violation may break: those of accelerations, forces and
            opening contacts. The others are sides of pyramids.
        elimination: Contact forces as a function of the unknowns.
    """

    program: Program
    constant: float
    softenable: int
    elimination: Elimination


def reduced_program(
    problem: WholeBodyProblem,
    motion: Motion,
    elimination: Elimination,
    sides: Array | None,
    miss_weight: float = 0.0,
) -> ReducedProgram:
    """The program of a problem.

    Args:
        problem: The instant.
        motion: Of the problem.
        elimination: Of the motion, with or without misses.
        sides: Sides of the friction pyramids of the contacts with friction, shape (k, edges, 3); None keeps cones.
        miss_weight: Cost of a squared miss of a contact acceleration.
    """
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
    return ReducedProgram(program, 0.5 * constant, softenable, elimination)


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
