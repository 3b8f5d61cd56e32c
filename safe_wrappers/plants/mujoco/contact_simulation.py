"""Physics substeps with every contact between robot and fixed world written down, in compiled code.

The same as `ContactReader` makes of `replay.evaluations`, which is the oracle, without Python between evaluations.
"""

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled
from safe_wrappers.plants.mujoco.contact_memory import ContactMemory
from safe_wrappers.plants.mujoco.native import mj_contactForce, mj_forwardSkip, mj_integratePos, mj_step

_NUMBERS = 10  # kept of a contact: point (3), normal (3), force (3), friction
_FIRST_SIZE = 64  # contacts for which there is room at first
_AHEAD = (0.5, 0.5, 1.0, 0.0)  # where Runge-Kutta's next evaluation is, in time steps
_WEIGHTS = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)


@compiled
def simulate(
    memory: ContactMemory,
    body_of_geom: NDArray[np.int64],
    substeps: int,
    timestep: float,
    runge_kutta: bool,
    fastest: float,
) -> tuple[NDArray[np.int64], Array, bool]:
    """Step the data, with the control that it has, and write the contacts of every evaluation down.

    Args:
        memory: Of the data, at the present state.
        body_of_geom: Which body of the robot a geom belongs to, 0 for the fixed world; the last is of geom -1.
        substeps: To make.
        timestep: s.
        runge_kutta: Whether these have four evaluations each, or one.
        fastest: Bound of squared lengths of positions, velocities and accelerations.

    Returns:
        kinds: Evaluation and body of each contact, shape (n, 2).
        numbers: Point, normal, force and friction of each contact, shape (n, 10).
        inside: Whether all numbers were within the bound.
    """
    kinds, numbers = np.empty((_FIRST_SIZE, 2), np.int64), np.empty((_FIRST_SIZE, _NUMBERS))
    count, evaluation, inside, wrench = 0, 0, True, np.zeros(6)
    qpos, qvel, qacc = memory.qpos, memory.qvel, memory.qacc
    nq, nv = qpos.size, qvel.size
    qpos0, qvel0, velocity, acceleration, rate = (
        qpos.copy(),
        qvel.copy(),
        qvel.copy(),
        qvel.copy(),
        qvel.copy(),
    )
    for _ in range(substeps):
        if runge_kutta:
            start = memory.time[0]
            for j in range(nq):
                qpos0[j] = qpos[j]
            for j in range(nv):
                qvel0[j] = qvel[j]
                velocity[j] = acceleration[j] = 0.0
        for stage in range(4 if runge_kutta else 1):
            if runge_kutta:
                mj_forwardSkip(memory.model, memory.data, 0, 1)
            else:
                mj_step(memory.model, memory.data)  # it leaves the forces that it has integrated in the data
            for i in range(memory.number[0]):
                if not _counts(memory, body_of_geom, i):
                    continue
                if count == len(kinds):
                    kinds, numbers = np.concatenate((kinds, kinds)), np.concatenate((numbers, numbers))
                kinds[count, 0] = evaluation
                mj_contactForce(memory.model, memory.data, i, wrench.ctypes.data)
                kinds[count, 1] = _read(memory, body_of_geom, i, wrench, numbers[count])
                count += 1
            evaluation += 1
            inside = inside and _squares(qacc) < fastest
            if not runge_kutta:
                continue
            weight, ahead = _WEIGHTS[stage], _AHEAD[stage]
            for j in range(nv):
                velocity[j] += weight * qvel[j]
                acceleration[j] += weight * qacc[j]
                rate[j] = ahead * qvel[j]
                qvel[j] = qvel0[j] + timestep * (ahead * qacc[j])
            if ahead:
                for j in range(nq):
                    qpos[j] = qpos0[j]
                mj_integratePos(memory.model, qpos.ctypes.data, rate.ctypes.data, timestep)
                memory.time[0] = start + ahead * timestep
        if runge_kutta:
            for j in range(nq):
                qpos[j] = qpos0[j]
            mj_integratePos(memory.model, qpos.ctypes.data, velocity.ctypes.data, timestep)
            for j in range(nv):
                qvel[j] = qvel0[j] + timestep * acceleration[j]
                memory.warmstart[j] = qacc[j]
    inside = inside and _squares(qvel) < fastest and _squares(qpos) < fastest
    return kinds[:count], numbers[:count], inside


@compiled
def _counts(memory: ContactMemory, body_of_geom: NDArray[np.int64], i: int) -> bool:
    """Whether a contact acts, between the robot and the fixed world."""
    first = 2 * memory.stride * i
    one = body_of_geom[memory.ints[first + memory.geom]]
    other = body_of_geom[memory.ints[first + memory.geom + 1]]
    return bool(memory.ints[first + memory.row] >= 0 and one != other and min(one, other) == 0)


@compiled
def _read(
    memory: ContactMemory, body_of_geom: NDArray[np.int64], i: int, wrench: Array, numbers: Array
) -> int:
    """Write a contact down; the body of the robot."""
    reals, first = memory.reals, memory.stride * i
    one = body_of_geom[memory.ints[2 * first + memory.geom]]
    # MuJoCo's normal points from the first geom to the second, and the force is on the second.
    sign = 1.0 if one == 0 else -1.0
    frame = first + memory.frame
    for j in range(3):
        numbers[j] = reals[first + memory.pos + j]
        numbers[3 + j] = sign * reals[frame + j]
        force = wrench[0] * reals[frame + j] + wrench[1] * reals[frame + 3 + j]
        numbers[6 + j] = sign * (force + wrench[2] * reals[frame + 6 + j])
    friction = first + memory.friction
    slides = memory.ints[2 * first + memory.dim] > 1
    numbers[9] = min(reals[friction], reals[friction + 1]) if slides else 0.0
    return int(one + body_of_geom[memory.ints[2 * first + memory.geom + 1]])


@compiled
def _squares(values: Array) -> float:
    total = 0.0
    for value in values:
        total += value * value
    return total
