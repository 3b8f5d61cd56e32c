"""The momentum of bodies of a MuJoCo model, at the state that a step has left."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.legged.centroidal import CentroidalMomentum, centroidal_momentum


class MomentumReader:
    """Reads it with kinematics of its own: after a step MuJoCo's own positions may lag behind the state.

    A motor's `armature`, the inertia of what spins inside it, belongs to no body and is in no momentum.

    Args:
        model: Whose data will be read; its masses may change.
        bodies: Ids of the bodies, shape (n,), with mass.
    """

    def __init__(self, model: mujoco.MjModel, bodies: NDArray[np.intp]) -> None:
        self._model, self._bodies = model, bodies
        self._data = mujoco.MjData(model)

    def read(self, data: mujoco.MjData) -> CentroidalMomentum | None:
        """Of the state that is in the data, which is only read; None where it is no finite numbers."""
        model, own, bodies = self._model, self._data, self._bodies
        own.qpos[:], own.qvel[:] = data.qpos, data.qvel
        own.mocap_pos[:], own.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(model, own)
        mujoco.mj_comPos(model, own)
        mujoco.mj_comVel(model, own)
        positions, motion = own.xipos[bodies], own.cvel[bodies]
        if not (np.isfinite(positions).all() and np.isfinite(motion).all()):
            return None
        # MuJoCo has the velocity of the point of each body that is at its whole tree's centre of mass just now.
        spin, arm = motion[:, :3], positions - own.subtree_com[model.body_rootid[bodies]]
        axes = own.ximat[bodies].reshape(-1, 3, 3)
        return centroidal_momentum(
            model.body_mass[bodies],
            positions,
            motion[:, 3:] + np.cross(spin, arm),
            (axes * model.body_inertia[bodies, None]) @ axes.transpose(0, 2, 1),
            spin,
        )
