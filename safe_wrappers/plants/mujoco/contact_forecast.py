"""A forecast of contacts: the forces of the ground on the robot while a control is held."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.plants.mujoco.forecast import RESETS
from safe_wrappers.plants.mujoco.model import fixed_bodies
from safe_wrappers.plants.mujoco.replay import evaluations

_FASTEST = float(mujoco.mjMAXVAL) ** 2
"""Bound of squared lengths: MuJoCo does not check the stages of the Runge-Kutta steps that are made here."""


class ContactForecast(NamedTuple):
    """Every contact of the robot with what does not move, at every evaluation of the physics of one held control.

    Attributes:
        steps: How many evaluations there are: one per physics substep, four with Runge-Kutta.
        step: Which of them each contact belongs to, shape (n,).
        body: Id of the body of the robot, shape (n,).
        point: Shape (n, 3), m.
        normal: Pointing at the robot, shape (n, 3).
        force: On the robot, shape (n, 3), N.
        friction: Coefficient of sliding that the model has for it, shape (n,); of two that differ with the direction
            the smaller one, and 0 for a contact without friction (condim 1).
        finite: False where numbers left MuJoCo's bounds (it then resets the state); the contacts are meaningless.
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
    """Reads the contacts of a model's moving bodies with the fixed world.

    `read` only copies MuJoCo's arrays; `forecast` evaluates all of them at once, because Python is slow.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        fixed = fixed_bodies(model)
        # The last entry is for geom -1, of something flexible: it moves, but is not a body of the robot.
        bodies = np.where(fixed, 0, np.arange(model.nbody))
        self._body_of_geom: list[int] = [*bodies[model.geom_bodyid].tolist(), -1]
        self._wrench = np.zeros(6)
        self.clear()

    def clear(self) -> None:
        """Forget what has been read."""
        self.count = 0
        self._kept: list[tuple[int, int, int, int]] = []
        self._forces: list[Array] = []
        self._copied = 0
        self._points: list[Array] = []
        self._frames: list[Array] = []
        self._friction: list[Array] = []
        self._dims: list[Array] = []

    def read(self, data: mujoco.MjData) -> None:
        """Copy every contact of a moving body with the fixed world, as MuJoCo has computed them last."""
        step = self.count
        self.count += 1
        if not data.ncon:
            return
        contact, body, before = data.contact, self._body_of_geom, len(self._kept)
        geoms, addresses = contact.geom.tolist(), contact.efc_address.tolist()
        for i, ((one, other), address) in enumerate(zip(geoms, addresses, strict=True)):
            first, second = body[one], body[other]
            if address < 0 or first == second or min(first, second) != 0:
                continue
            mujoco.mj_contactForce(self._model, data, i, self._wrench)
            self._forces.append(self._wrench.copy())
            # MuJoCo's normal points from the first geom to the second, and the force is on the second.
            self._kept.append((step, self._copied + i, first or second, 1 if first == 0 else -1))
        if len(self._kept) == before:
            return
        self._copied += len(geoms)
        self._points.append(contact.pos.copy())
        self._frames.append(contact.frame.copy())
        self._friction.append(contact.friction.copy())
        self._dims.append(contact.dim.copy())

    def forecast(self, finite: bool) -> ContactForecast:
        """All contacts that have been read since `clear`."""
        if not self._kept:
            none, nowhere = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
            return ContactForecast(self.count, none, none, nowhere, nowhere, nowhere, np.zeros(0), finite)
        step, which, body, side = np.array(self._kept, dtype=np.int64).T
        frames = np.concatenate(self._frames)[which].reshape(-1, 3, 3)
        sign = side[:, None].astype(np.float64)
        friction = np.concatenate(self._friction)[which, :2].min(axis=1)
        return ContactForecast(
            steps=self.count,
            step=step,
            body=body,
            point=np.concatenate(self._points)[which],
            normal=sign * frames[:, 0],
            force=sign * np.einsum("ki,kij->kj", np.array(self._forces)[:, :3], frames),
            friction=np.where(np.concatenate(self._dims)[which] > 1, friction, 0.0),
            finite=finite,
        )

    def follow(self, data: mujoco.MjData, substeps: int) -> ContactForecast:
        """Step the data, with the control it has, and return the contacts of all these physics substeps."""
        self.clear()
        data.warning.number[RESETS] = 0
        inside = True

        def visit(at: mujoco.MjData, _: float) -> None:
            nonlocal inside
            self.read(at)
            inside = inside and bool(at.qacc @ at.qacc < _FASTEST)

        for _ in range(substeps):
            evaluations(self._model, data, visit)
        inside = inside and bool(data.qvel @ data.qvel < _FASTEST and data.qpos @ data.qpos < _FASTEST)
        return self.forecast(finite=inside and not data.warning.number[RESETS].any())


def can_touch_the_world(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which moving bodies have a geom that may meet one of the fixed world's with friction, shape (nbody,)."""
    fixed = fixed_bodies(model)[model.geom_bodyid]
    kind, other, size = model.geom_contype, model.geom_conaffinity, model.geom_condim
    found = np.zeros(model.nbody, dtype=bool)
    for ground in np.flatnonzero(fixed):
        meets = (kind & other[ground]) | (kind[ground] & other)
        found[model.geom_bodyid[~fixed & (meets != 0) & (np.maximum(size, size[ground]) > 1)]] = True
    for one, two, dim in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True):
        if dim > 1 and fixed[one] != fixed[two]:
            found[model.geom_bodyid[two if fixed[one] else one]] = True
    return found
