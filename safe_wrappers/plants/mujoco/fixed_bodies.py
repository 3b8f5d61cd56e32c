"""Which bodies of a MuJoCo model no force can move."""

import mujoco
import numpy as np
from numpy.typing import NDArray


def fixed_bodies(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Bodies with no joint between them and the world, mocap bodies among them, shape (nbody,).

    `body_weldid` is not enough: a mocap body is welded to the world (0) before MuJoCo 3.12, to itself from then on.
    """
    return np.asarray(model.body_dofnum[model.body_weldid] == 0)
