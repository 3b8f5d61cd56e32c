"""The momentum of bodies of a MuJoCo model, at the state after a step."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.legged.centroidal import CentroidalMomentum, centroidal_momentum
from safe_wrappers.plants.mujoco.model import kinematics


class MomentumReader:
    """Computes the momentum of some bodies with mass, ids of shape (n,). Armature, of no body, is left out."""

    def __init__(self, model: mujoco.MjModel, bodies: NDArray[np.intp]) -> None:
        self._model, self._bodies = model, bodies
        self._data = mujoco.MjData(model)

    def read(self, data: mujoco.MjData) -> CentroidalMomentum | None:
        """The momentum at the state of the data, which are only read; None where numbers are not finite."""
        model, own, bodies = self._model, self._data, self._bodies
        kinematics(model, data, own)
        positions, motion = own.xipos[bodies], own.cvel[bodies]
        if not (np.isfinite(positions).all() and np.isfinite(motion).all()):
            return None
        # MuJoCo's cvel is the velocity of the body's point at the centre of mass of its whole tree.
        spin, arm = motion[:, :3], positions - own.subtree_com[model.body_rootid[bodies]]
        axes = own.ximat[bodies].reshape(-1, 3, 3)
        return centroidal_momentum(
            model.body_mass[bodies],
            positions,
            motion[:, 3:] + np.cross(spin, arm),
            (axes * model.body_inertia[bodies, None]) @ axes.transpose(0, 2, 1),
            spin,
        )
