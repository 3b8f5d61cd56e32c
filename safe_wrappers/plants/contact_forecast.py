"""A forecast of contacts: the forces of the ground on the robot while a control is held."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.plants.replay import evaluations

Array = NDArray[np.float64]


class ContactForecast(NamedTuple):
    """Every contact of the robot with what does not move, at every evaluation of the physics of one held control.

    Attributes:
        steps: How many evaluations there are: one per physics substep, four with Runge-Kutta.
        step: Which of them each contact belongs to, shape (n,).
        body: Id of the body of the robot, shape (n,).
        point: Shape (n, 3), m.
        normal: Pointing at the robot, shape (n, 3).
        force: On the robot, shape (n, 3), N.
        friction: Coefficient that the model has for it, shape (n,).
        finite: False where the simulation ends in numbers that are none; then the contacts say nothing.
    """

    steps: int
    step: NDArray[np.int64]
    body: NDArray[np.int64]
    point: Array
    normal: Array
    force: Array
    friction: Array
    finite: bool


class ContactReader:
    """Reads the contacts of moving bodies with the fixed world.

    Args:
        model: Whose data will be read.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        fixed = model.body_weldid == 0
        # Geom -1, of something flexible, is the last entry: no robot's body.
        self._body_of_geom: list[int] = [*np.where(fixed, 0, np.arange(model.nbody))[model.geom_bodyid], 0]
        self._wrench = np.zeros(6)

    def read(self, data: mujoco.MjData) -> list[tuple[int, Array, Array, Array, float]]:
        """Body, point, normal, force and friction of every contact as MuJoCo has computed them last."""
        found = []
        for i in range(data.ncon):
            contact = data.contact[i]
            first, second = self._body_of_geom[contact.geom1], self._body_of_geom[contact.geom2]
            if contact.efc_address < 0 or (first == 0) == (second == 0):
                continue
            mujoco.mj_contactForce(self._model, data, i, self._wrench)
            frame = contact.frame.reshape(3, 3)
            # MuJoCo's normal points from the first geom to the second, and the force is on the second.
            sign = 1.0 if first == 0 else -1.0
            friction = float(contact.friction[0]) if contact.dim > 1 else 0.0
            force = sign * (self._wrench[:3] @ frame)
            found.append((first or second, contact.pos.copy(), sign * frame[0], force, friction))
        return found


def forecast_contacts(
    model: mujoco.MjModel, data: mujoco.MjData, substeps: int, reader: ContactReader
) -> ContactForecast:
    """Step the data through one control interval with the control it has, and write its contacts down.

    Args:
        model: The plant's own.
        data: At the present state, with the control; it is left at the end of the interval.
        substeps: Physics substeps per control interval.
        reader: For this model.
    """
    step: list[int] = []
    rows: list[tuple[int, Array, Array, Array, float]] = []
    count = 0

    def visit(at: mujoco.MjData, _: float) -> None:
        nonlocal count
        found = reader.read(at)
        rows.extend(found)
        step.extend([count] * len(found))
        count += 1

    for _ in range(substeps):
        evaluations(model, data, visit)
    finite = bool(np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all())
    body, point, normal, force, friction = zip(*rows, strict=True) if rows else ((),) * 5
    return ContactForecast(
        steps=count,
        step=np.array(step, dtype=np.int64),
        body=np.array(body, dtype=np.int64),
        point=np.array(point, dtype=np.float64).reshape(-1, 3),
        normal=np.array(normal, dtype=np.float64).reshape(-1, 3),
        force=np.array(force, dtype=np.float64).reshape(-1, 3),
        friction=np.array(friction, dtype=np.float64),
        finite=finite,
    )
