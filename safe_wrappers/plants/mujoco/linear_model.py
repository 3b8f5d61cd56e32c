"""`qacc = drift + effect @ u` of a MuJoCo model at the present set of active contacts and limits."""

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.plants.mujoco.actuators import AffineActuators
from safe_wrappers.plants.mujoco.model import inertia

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_QUADRATIC = int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC)


def drift_and_effect(
    model: mujoco.MjModel, data: mujoco.MjData, actuators: AffineActuators
) -> tuple[Array, Array]:
    """Shapes (nv,) and (nv, nu), from data that are up to date; exact for pyramidal friction cones."""
    gain, _ = actuators.gain_and_bias(data.actuator_length, data.actuator_velocity)
    least, most = actuators.acting_range(data.actuator_length, data.actuator_velocity)
    moment = actuators.moment(data)
    force_per_control = moment * gain[:, None]
    saturated = most <= least
    effect = _solve_inertia(model, data, force_per_control).T
    effect = np.where(saturated, 0.0, effect)
    return data.qacc - effect @ np.where(saturated, 0.0, np.clip(data.ctrl, least, most)), effect


def _solve_inertia(m: mujoco.MjModel, d: mujoco.MjData, rows: Array) -> Array:
    """`rows @ inv(M + J_a' D_a J_a)`: accelerations per generalised force with the active constraints."""
    out = np.zeros_like(rows)
    active = d.efc_state == _QUADRATIC if d.nefc else np.zeros(0, bool)
    if not active.any():
        mujoco.mj_solveM(m, d, out, np.ascontiguousarray(rows))
        return out
    jacobian = _constraint_jacobian(m, d)[active]
    stiff = inertia(m, d) + jacobian.T @ (d.efc_D[active][:, None] * jacobian)
    return np.asarray(np.linalg.solve(stiff, rows.T).T)


def _constraint_jacobian(m: mujoco.MjModel, d: mujoco.MjData) -> Array:
    if not mujoco.mj_isSparse(m):
        return np.array(d.efc_J.reshape(d.nefc, m.nv))
    dense = np.zeros((d.nefc, m.nv))
    mujoco.mju_sparse2dense(dense, d.efc_J, d.efc_J_rownnz, d.efc_J_rowadr, d.efc_J_colind)
    return dense


def position_rate(model: mujoco.MjModel, qpos: Array, qvel: Array) -> Array:
    """Time derivative of the positions, shape (nq,)."""
    if model.nq == model.nv:
        return qvel.copy()
    rate = np.zeros(model.nq)
    for j in range(model.njnt):
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        kind = model.jnt_type[j]
        if kind == _FREE:
            rate[q : q + 3] = qvel[v : v + 3]
            q, v = q + 3, v + 3
        if kind in (_FREE, _BALL):
            # Angular velocities of these joints are in the body's frame; mju_derivQuat wants the world's.
            turn = np.zeros(4)
            mujoco.mju_mulQuatAxis(turn, qpos[q : q + 4].copy(), qvel[v : v + 3].copy())
            rate[q : q + 4] = 0.5 * turn
        else:
            rate[q] = qvel[v]
    return rate
