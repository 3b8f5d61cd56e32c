"""What MuJoCo 2.3.3 did where two boxes touch, put back into the MuJoCo of today.

It reported half of the true penetration wherever the touched face belongs to the second box. So did all versions
up to 3.3; from 3.4 on MuJoCo reports all of it, and from 3.12 on it finds the contact points in another way.
"""

import mujoco
import numpy as np

HALVES_ITSELF = mujoco.mj_version() < 340
OTHER_CORNERS = mujoco.mj_version() >= 3_012_000
"""Whether two boxes may touch in other points than in 2.3.3 (one corner instead of two, say), at the same depth."""


def step_as_2_3_3(model, data):
    mujoco.mj_step1(model, data)
    if halve_penetrations(model, data):
        mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_step2(model, data)


def forward_as_2_3_3(model, data):
    mujoco.mj_fwdPosition(model, data)
    halve_penetrations(model, data)
    mujoco.mj_sensorPos(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_sensorVel(model, data)
    mujoco.mj_fwdActuation(model, data)
    mujoco.mj_fwdAcceleration(model, data)
    mujoco.mj_fwdConstraint(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    mujoco.mj_sensorAcc(model, data)


def halve_penetrations(model, data):
    """Halve the depth of box-box contacts on a face of the second box; whether there were any to halve."""
    if HALVES_ITSELF:
        return False
    pairs = data.contact.geom
    boxes = (model.geom_type[pairs] == mujoco.mjtGeom.mjGEOM_BOX).all(axis=1)
    normals = data.contact.frame[:, :3]
    first, second = (
        np.abs(np.einsum("nij,ni->nj", data.geom_xmat[pairs[:, side]].reshape(-1, 3, 3), normals)).max(axis=1)
        for side in (0, 1)
    )
    halved = boxes & (second > first) & (second > 1.0 - 1e-12)
    if not halved.any():
        return False
    data.contact.dist[halved] *= 0.5
    mujoco.mj_makeConstraint(model, data)
    mujoco.mj_island(model, data)
    mujoco.mj_projectConstraint(model, data)
    return True
