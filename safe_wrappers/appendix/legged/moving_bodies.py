"""Masses, motion and Jacobians of the bodies of a MuJoCo model, as the centroidal functions take them."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array


class Bodies(NamedTuple):
    """Motion of the n moving bodies of a robot, in the world's axes, as arguments of the centroidal functions.

    Attributes:
        ids: Shape (n,).
        masses: Shape (n,), kg.
        positions: Of their centres of mass, shape (n, 3), m.
        inertias: About these, shape (n, 3, 3), kg m^2.
        velocities: Of these, shape (n, 3), m/s.
        angular_velocities: Shape (n, 3), rad/s.
        linear_jacobians: Of these, shape (n, 3, nv).
        angular_jacobians: Shape (n, 3, nv).
        linear_drifts: `dJ/dt qvel`, shape (n, 3), m/s^2.
        angular_drifts: The same of the angular velocities, shape (n, 3), rad/s^2.
    """

    ids: NDArray[np.intp]
    masses: Array
    positions: Array
    inertias: Array
    velocities: Array
    angular_velocities: Array
    linear_jacobians: Array
    angular_jacobians: Array
    linear_drifts: Array
    angular_drifts: Array


def moving_bodies(model: mujoco.MjModel, data: mujoco.MjData, root: int = 0) -> Bodies:
    """The bodies with mass in the tree below a body, at data that is up to date (`mj_forward`).

    Args:
        model: The model.
        data: Is only read.
        root: Id of the tree's root, itself included; 0, the world, is everything.
    """
    ids = np.array(
        [b for b in range(1, model.nbody) if model.body_mass[b] > 0.0 and _below(model, b, root)], np.intp
    )
    n = len(ids)
    linear, angular = np.zeros((n, 3, model.nv)), np.zeros((n, 3, model.nv))
    linear_drift, angular_drift = np.zeros((n, 3)), np.zeros((n, 3))
    dot, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for row, body in enumerate(ids):
        mujoco.mj_jacBodyCom(model, data, linear[row], angular[row], body)
        mujoco.mj_jacDot(model, data, dot, turn, data.xipos[body], body)
        linear_drift[row], angular_drift[row] = dot @ data.qvel, turn @ data.qvel
    axes = data.ximat[ids].reshape(n, 3, 3)
    return Bodies(
        ids=ids,
        masses=model.body_mass[ids],
        positions=data.xipos[ids],
        inertias=np.einsum("nij,nj,nkj->nik", axes, model.body_inertia[ids], axes),
        velocities=linear @ data.qvel,
        angular_velocities=angular @ data.qvel,
        linear_jacobians=linear,
        angular_jacobians=angular,
        linear_drifts=linear_drift,
        angular_drifts=angular_drift,
    )


def _below(model: mujoco.MjModel, body: int, root: int) -> bool:
    while body > root:  # a parent's id is smaller than its children's
        body = int(model.body_parentid[body])
    return body == root
