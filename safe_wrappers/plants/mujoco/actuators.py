"""MuJoCo actuators as an affine map from control to force; those that are none are refused by name.

`force = gain * ctrl + bias`, `gain = g0 + g1 length + g2 velocity`, likewise `bias`, clamped to `forcerange`. Beyond
the clamp more control changes nothing, so it becomes a bound on the control.
"""

import mujoco
import numpy as np

from safe_wrappers.errors import Array, UnsupportedEnvError
from safe_wrappers.plants.mujoco.model import AT_A_JOINT, SCALAR_JOINTS, control_range

_QUADRATIC = int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC)
_HANDLED = (
    ("transmission", "actuator_trntype", mujoco.mjtTrn, ("joint", "jointinparent", "site", "tendon")),
    ("activation dynamics", "actuator_dyntype", mujoco.mjtDyn, ("none",)),
    ("gain type", "actuator_gaintype", mujoco.mjtGain, ("fixed", "affine")),
    ("bias type", "actuator_biastype", mujoco.mjtBias, ("none", "affine")),
)


def _refuse_unsupported(model: mujoco.MjModel) -> None:
    """Raise for any actuator whose force is not affine in its control at a given state."""
    every = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION))
    # Not nu: from MuJoCo 3.12 on an actuator may have no control at all.
    for i, group in enumerate(model.actuator_group.tolist()):
        name = model.actuator(i).name or f"#{i}"
        # Groups above 30 cannot be disabled.
        if every or (0 <= group <= 30 and model.opt.disableactuator & 1 << group):
            raise UnsupportedEnvError(
                f"actuator {name!r} is disabled (actuatorgroupdisable, or the flag actuation), which MujocoPlant "
                "does not model; enable it, or take it out of the model"
            )
        for what, field, kinds, handled in _HANDLED:
            kind = kinds(int(getattr(model, field)[i])).name.partition("_")[2].lower()
            if kind not in handled:
                _refuse(name, f"{what} {kind}", ", ".join(handled))
        if hasattr(model, "actuator_delay") and model.actuator_delay[i] > 0.0:
            _refuse(name, f"a delay of {model.actuator_delay[i]} s", "none (say delay_s instead)")
    for kind, limited in (("joint", model.jnt_actfrclimited), ("tendon", model.tendon_actfrclimited)):
        for first in np.flatnonzero(limited)[:1]:
            raise UnsupportedEnvError(
                f"{kind} {getattr(model, kind)(first).name or f'#{first}'!r} clamps the sum of its actuators' forces "
                "(actuatorfrcrange), which MujocoPlant does not model; give the actuators a forcerange instead, or "
                "use AnalyticPlant"
            )


def _refuse(actuator: str, what: str, handled: str) -> None:
    raise UnsupportedEnvError(
        f"actuator {actuator!r} has {what}, which MujocoPlant cannot write as f(x) + g(x) u; it handles: "
        f"{handled}. Use AnalyticPlant with your own f and g."
    )


class AffineActuators:
    """Gain, bias and acting control range of every actuator of a model, whose constants are read once."""

    def __init__(self, model: mujoco.MjModel) -> None:
        _refuse_unsupported(model)
        self._model, self._range = model, control_range(model)
        self._gain, self._bias = model.actuator_gainprm[:, :3].copy(), model.actuator_biasprm[:, :3].copy()
        self._gain[model.actuator_gaintype != int(mujoco.mjtGain.mjGAIN_AFFINE), 1:] = 0.0
        self._bias[model.actuator_biastype != int(mujoco.mjtBias.mjBIAS_AFFINE)] = 0.0
        self._units, self._mobility = np.eye(model.nv), np.empty((model.nv, model.nv))
        self._clamps, self._varies = bool(model.actuator_forcelimited.any()), bool(self._gain[:, 1:].any())
        on_joints = np.isin(model.actuator_trntype, AT_A_JOINT)
        kinds = model.jnt_type[model.actuator_trnid[on_joints, 0]] if model.njnt else np.zeros(0)
        self._turns = not (on_joints.all() and np.isin(kinds, SCALAR_JOINTS).all())
        self._moment: Array | None = None

    def gain_and_bias(self, length: Array, velocity: Array) -> tuple[Array, Array]:
        """Force per control and force at zero control, shapes (nu,) and (nu,)."""
        gain, bias = (c[:, 0] + c[:, 1] * length + c[:, 2] * velocity for c in (self._gain, self._bias))
        return gain, bias

    def moment(self, data: mujoco.MjData) -> Array:
        """Generalised force per unit actuator force, shape (nu, nv)."""
        if self._moment is not None and not self._turns:
            return self._moment
        self._moment = moment = np.zeros((self._model.nu, self._model.nv))
        sparse = data.actuator_moment.reshape(-1), data.moment_rownnz, data.moment_rowadr
        mujoco.mju_sparse2dense(moment, *sparse, data.moment_colind.reshape(-1))
        return moment

    def motion(self, data: mujoco.MjData) -> tuple[Array, Array]:
        """Length and velocity of the transmissions (m or rad, per second), of data whose poses are up to date."""
        for compute in (mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_transmission):
            compute(self._model, data)
        return data.actuator_length, self.moment(data) @ data.qvel

    def acting_range(self, length: Array, velocity: Array, control_dt: float = 0.0) -> tuple[Array, Array]:
        """The controls between which the force still changes, inside ctrlrange; shapes (nu,) and (nu,).

        Zero width where an actuator is saturated over its whole ctrlrange. Length and velocity are those of the
        transmissions. The range is widened by what a speed servo's own force can shift its clamp within `control_dt`,
        s; `actuator_acc0`, acceleration per force in the reference pose, bounds how fast.
        """
        m, (low, high) = self._model, self._range
        if not self._clamps:
            return low, high
        gain, bias = self.gain_and_bias(length, velocity)
        clamped = m.actuator_forcelimited.astype(bool) & (gain != 0.0)
        scale = np.where(clamped, gain, 1.0)
        ends = (m.actuator_forcerange - bias[:, None]) / scale[:, None]
        lever, strongest = (np.abs(a).max(axis=1) for a in (m.actuator_gear, m.actuator_forcerange))
        widen = np.abs(self._bias[:, 2]) * lever * m.actuator_acc0 * strongest * control_dt / np.abs(scale)
        least, most = np.clip([ends.min(axis=1) - widen, ends.max(axis=1) + widen], low, high)
        return np.where(clamped, least, low), np.where(clamped, most, high)

    def drift_and_effect(self, data: mujoco.MjData) -> tuple[Array, Array]:
        """`qacc = drift + effect @ u`, shapes (nv,) and (nv, nu), at the present set of active contacts and limits.

        The data must be up to date. Exact for pyramidal friction cones.
        """
        m, mobility = self._model, self._mobility
        mujoco.mj_solveM(m, data, mobility, self._units)
        active = np.flatnonzero(data.efc_state == _QUADRATIC) if data.nefc else ()
        if len(active):  # inv(M + J' D J)
            jacobian = np.zeros((data.nefc, m.nv))
            if mujoco.mj_isSparse(m):
                places = data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
                mujoco.mju_sparse2dense(jacobian, data.efc_J, *places)
            else:
                jacobian = data.efc_J[: jacobian.size].reshape(
                    jacobian.shape
                )  # without rows of zeros at its end
            moved = jacobian[active] @ mobility
            give = moved @ jacobian[active].T
            give.flat[:: len(active) + 1] += 1.0 / data.efc_D[active]
            mobility -= moved.T @ np.linalg.solve(give, moved)
        (least, most), gain = self._range, self._gain[:, 0]
        if self._clamps or self._varies:
            length, velocity = data.actuator_length, data.actuator_velocity
            least, most = self.acting_range(length, velocity)
            gain = np.where(most > least, self.gain_and_bias(length, velocity)[0], 0.0)
        effect = mobility @ (self.moment(data).T * gain)
        return data.qacc - effect @ np.minimum(np.maximum(data.ctrl, least), most), effect
