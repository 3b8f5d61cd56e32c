"""MuJoCo actuators as an affine map from control to force, refusing by name what is not one.

`force = gain * ctrl + bias`, `gain = g0 + g1 length + g2 velocity`, likewise `bias`; then `forcerange` clamps
it. Inside the clamp the map is affine with constants of the present state; outside it more control changes
nothing, so the clamp becomes a bound on the control that still acts.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import UnsupportedEnvError

Array = NDArray[np.float64]

_JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_TRANSMISSIONS = (*_JOINT_TRANSMISSIONS, int(mujoco.mjtTrn.mjTRN_SITE), int(mujoco.mjtTrn.mjTRN_TENDON))
_NO_DYNAMICS = int(mujoco.mjtDyn.mjDYN_NONE)
_FIXED_GAIN, _AFFINE_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
_NO_BIAS, _AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)


def refuse_unsupported(model: mujoco.MjModel) -> None:
    """Raise for any actuator whose force is not affine in its control at a given state."""
    for i in range(
        len(model.actuator_trntype)
    ):  # not nu: from 3.12 on an actuator may have no control at all
        name = model.actuator(i).name or f"#{i}"
        transmission, dynamics = int(model.actuator_trntype[i]), int(model.actuator_dyntype[i])
        gain, bias = int(model.actuator_gaintype[i]), int(model.actuator_biastype[i])
        if transmission not in _TRANSMISSIONS:
            kind = mujoco.mjtTrn(transmission).name[6:].lower()
            _refuse(name, f"transmission {kind}", "joint, jointinparent, site, tendon")
        if dynamics != _NO_DYNAMICS:
            _refuse(name, f"activation dynamics {mujoco.mjtDyn(dynamics).name[6:].lower()}", "none")
        if gain not in (_FIXED_GAIN, _AFFINE_GAIN):
            _refuse(name, f"gain type {mujoco.mjtGain(gain).name[7:].lower()}", "fixed, affine")
        if bias not in (_NO_BIAS, _AFFINE_BIAS):
            _refuse(name, f"bias type {mujoco.mjtBias(bias).name[7:].lower()}", "none, affine")
        if hasattr(model, "actuator_delay") and model.actuator_delay[i] > 0.0:
            _refuse(name, f"a delay of {model.actuator_delay[i]} s", "none (say delay_s instead)")
    if model.jnt_actfrclimited.any():
        joint = model.joint(int(np.flatnonzero(model.jnt_actfrclimited)[0])).name
        raise UnsupportedEnvError(
            f"joint {joint!r} clamps the sum of its actuators' forces (actuatorfrcrange), which MujocoPlant does "
            "not model; give the actuators a forcerange instead, or use AnalyticPlant"
        )
    if model.tendon_actfrclimited.any():
        tendon = model.tendon(int(np.flatnonzero(model.tendon_actfrclimited)[0])).name
        raise UnsupportedEnvError(
            f"tendon {tendon!r} clamps the sum of its actuators' forces (actuatorfrcrange), which MujocoPlant "
            "does not model; give the actuators a forcerange instead, or use AnalyticPlant"
        )


def _refuse(actuator: str, what: str, handled: str) -> None:
    raise UnsupportedEnvError(
        f"actuator {actuator!r} has {what}, which MujocoPlant cannot write as f(x) + g(x) u; it handles: "
        f"{handled}. Use AnalyticPlant with your own f and g."
    )


class AffineActuators:
    """Gain, bias and acting control range of every actuator of one model.

    Args:
        model: The plant's own model; its arrays are read at every call, so they may be changed.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        refuse_unsupported(model)
        self._model = model
        self._moment = np.zeros((model.nu, model.nv))
        self._on_joints: tuple[Array, Array, Array] | None = None
        self._joints_suffice = False

    def gain_and_bias(self, length: Array, velocity: Array) -> tuple[Array, Array]:
        """Force per control and force at zero control, shapes (nu,) and (nu,)."""
        m = self._model
        affine = m.actuator_gaintype == _AFFINE_GAIN
        gain = m.actuator_gainprm[:, 0] + affine * (
            m.actuator_gainprm[:, 1] * length + m.actuator_gainprm[:, 2] * velocity
        )
        biased = m.actuator_biastype == _AFFINE_BIAS
        bias = biased * (
            m.actuator_biasprm[:, 0] + m.actuator_biasprm[:, 1] * length + m.actuator_biasprm[:, 2] * velocity
        )
        return gain, bias

    def moment(self, data: mujoco.MjData) -> Array:
        """Generalised force per unit actuator force, shape (nu, nv)."""
        mujoco.mju_sparse2dense(
            self._moment,
            data.actuator_moment.reshape(-1),
            data.moment_rownnz,
            data.moment_rowadr,
            data.moment_colind.reshape(-1),
        )
        return self._moment

    def acting_range(self, length: Array, velocity: Array, control_dt: float = 0.0) -> tuple[Array, Array]:
        """The controls between which the force still changes, inside ctrlrange; shapes (nu,) and (nu,).

        An actuator that is saturated over its whole ctrlrange gets a range of zero width.

        Args:
            length: Of the actuators' transmissions, m or rad, shape (nu,).
            velocity: Of the same, shape (nu,).
            control_dt: Widen by what a speed servo's own force can shift its clamp within this time, s; MuJoCo's
                `actuator_acc0` (acceleration per force in the reference pose) bounds how fast.
        """
        m = self._model
        limited = m.actuator_ctrllimited.astype(bool)
        low = np.where(limited, m.actuator_ctrlrange[:, 0], -np.inf)
        high = np.where(limited, m.actuator_ctrlrange[:, 1], np.inf)
        clamped = m.actuator_forcelimited.astype(bool)
        if not clamped.any():
            return low, high
        gain, bias = self.gain_and_bias(length, velocity)
        acts = clamped & (gain != 0.0)
        scale = np.where(acts, gain, 1.0)
        ends = (m.actuator_forcerange - bias[:, None]) / scale[:, None]
        feedback = np.abs(m.actuator_biastype * m.actuator_biasprm[:, 2])
        strongest = np.abs(m.actuator_forcerange).max(axis=1)
        reach = np.abs(m.actuator_gear).max(axis=1) * m.actuator_acc0 * strongest * control_dt
        widen = feedback * reach / np.abs(scale)
        least = np.where(acts, ends.min(axis=1) - widen, -np.inf)
        most = np.where(acts, ends.max(axis=1) + widen, np.inf)
        return np.clip(least, low, high), np.clip(most, low, high)

    def motion_without_kinematics(self, qpos: Array, qvel: Array) -> tuple[Array, Array] | None:
        """Length and velocity where joints alone tell all that a clamp depends on, else None."""
        m = self._model
        if self._on_joints is None:
            depends = m.actuator_forcelimited.astype(bool) & (
                m.actuator_biasprm[:, 1:3].any(axis=1) | m.actuator_gainprm[:, 1:3].any(axis=1)
            )
            depends &= (m.actuator_biastype > 0) | (m.actuator_gaintype > 0)
            scalar = np.isin(m.actuator_trntype, _JOINT_TRANSMISSIONS)
            joint = np.where(scalar, m.actuator_trnid[:, 0], 0)
            scalar &= m.jnt_type[joint] >= int(mujoco.mjtJoint.mjJNT_SLIDE)  # slide or hinge
            self._joints_suffice = bool((scalar | ~depends).all())
            self._on_joints = (scalar * m.actuator_gear[:, 0], m.jnt_qposadr[joint], m.jnt_dofadr[joint])
        if not self._joints_suffice:
            return None
        gear, q, v = self._on_joints
        return gear * qpos[q], gear * qvel[v]
