"""MuJoCo actuators as an affine map from control to force; those that are none are refused by name.

`force = gain * ctrl + bias`, `gain = g0 + g1 length + g2 velocity`, likewise `bias`, clamped to `forcerange`. Beyond
the clamp more control changes nothing, so it becomes a bound on the control.
"""

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.compiled import compiled
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.model import AT_A_JOINT, Remade, control_range

_AFFINE_GAIN, _AFFINE_BIAS = int(mujoco.mjtGain.mjGAIN_AFFINE), int(mujoco.mjtBias.mjBIAS_AFFINE)
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
    for i in range(len(model.actuator_trntype)):
        name = model.actuator(i).name or f"#{i}"
        if every or model.opt.disableactuator & _bit(model.actuator_group[i]):
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
        if limited.any():
            first = int(np.flatnonzero(limited)[0])
            name = getattr(model, kind)(first).name or f"#{first}"
            raise UnsupportedEnvError(
                f"{kind} {name!r} clamps the sum of its actuators' forces (actuatorfrcrange), which MujocoPlant "
                "does not model; give the actuators a forcerange instead, or use AnalyticPlant"
            )


def _bit(group: int) -> int:
    """Of an actuator's group in `disableactuator`; those above 30 cannot be disabled."""
    return 1 << int(group) if 0 <= group <= 30 else 0


def _refuse(actuator: str, what: str, handled: str) -> None:
    raise UnsupportedEnvError(
        f"actuator {actuator!r} has {what}, which MujocoPlant cannot write as f(x) + g(x) u; it handles: "
        f"{handled}. Use AnalyticPlant with your own f and g."
    )


class Actuators(NamedTuple):
    """MuJoCo's arrays that describe the actuators of a model, or of n models, one beside the other."""

    gain_type: NDArray[Any]
    gain: Array
    bias_type: NDArray[Any]
    bias: Array
    force_limited: NDArray[Any]
    force_range: Array
    control_limited: NDArray[Any]
    control_range: Array
    gear: Array
    acceleration: Array

    @staticmethod
    def of(m: mujoco.MjModel) -> "Actuators":
        """The model's own arrays."""
        kinds = m.actuator_gaintype, m.actuator_gainprm, m.actuator_biastype, m.actuator_biasprm
        limits = m.actuator_forcelimited, m.actuator_forcerange, m.actuator_ctrllimited, m.actuator_ctrlrange
        return Actuators(*kinds, *limits, m.actuator_gear, m.actuator_acc0)


@compiled
def _gain(act: Actuators, i: int, length: Array, velocity: Array) -> float:
    gain = act.gain[i, 0]
    if act.gain_type[i] == _AFFINE_GAIN:
        gain += act.gain[i, 1] * length[i] + act.gain[i, 2] * velocity[i]
    return float(gain)


@compiled
def _acting_range(
    act: Actuators, length: Array, velocity: Array, control_dt: float, least: Array, most: Array
) -> None:
    """Writes `AffineActuators.acting_range` into `least` and `most`."""
    for i in range(len(least)):
        low, high = -math.inf, math.inf
        if act.control_limited[i]:
            low, high = act.control_range[i, 0], act.control_range[i, 1]
        scale, offset = _gain(act, i, length, velocity), 0.0
        if act.bias_type[i] == _AFFINE_BIAS:
            offset = act.bias[i, 0] + act.bias[i, 1] * length[i] + act.bias[i, 2] * velocity[i]
        least[i], most[i] = low, high
        if act.force_limited[i] and scale != 0.0:
            ends = (act.force_range[i, 0] - offset) / scale, (act.force_range[i, 1] - offset) / scale
            feedback = abs(act.bias[i, 2]) if act.bias_type[i] == _AFFINE_BIAS else 0.0
            strongest = max(abs(act.force_range[i, 0]), abs(act.force_range[i, 1]))
            lever = 0.0
            for j in range(act.gear.shape[1]):
                lever = max(lever, abs(act.gear[i, j]))
            widen = feedback * (lever * act.acceleration[i] * strongest * control_dt) / abs(scale)
            least[i] = min(max(min(ends[0], ends[1]) - widen, low), high)
            most[i] = min(max(max(ends[0], ends[1]) + widen, low), high)


@compiled
def _respond(
    act: Actuators,
    length: Array,
    velocity: Array,
    control: Array,
    qacc: Array,
    moment: Array,
    counts: NDArray[Any],
    starts: NDArray[Any],
    columns: NDArray[Any],
    mobility: Array,
    state: NDArray[Any],
    jacobian: Array,
    stiffness: Array,
) -> tuple[Array, Array]:
    """`drift` and `effect` of `qacc = drift + effect @ u`; `mobility`, the inverse of the inertia, is overwritten.

    The arrays are MuJoCo's of the actuators, of their sparse moment, and of the constraints, whose Jacobian is dense.
    """
    n, controls = len(qacc), len(control)
    least, most, moved = np.empty(controls), np.empty(controls), np.empty(n)
    _acting_range(act, length, velocity, 0.0, least, most)
    # inv(M + J' D J), one active row after another.
    for row in range(len(state)):
        if state[row] != _QUADRATIC:
            continue
        give = 1.0 / stiffness[row]
        for i in range(n):
            moved[i] = 0.0
            for j in range(n):
                moved[i] += mobility[i, j] * jacobian[row, j]
            give += jacobian[row, i] * moved[i]
        for i in range(n):
            for j in range(n):
                mobility[i, j] -= moved[i] * moved[j] / give
    drift, effect = qacc.copy(), np.zeros((n, controls))
    for k in range(controls):
        if most[k] <= least[k]:
            continue
        scale, acting = _gain(act, k, length, velocity), min(max(control[k], least[k]), most[k])
        for place in range(starts[k], starts[k] + counts[k]):
            j = columns[place]
            for i in range(n):
                effect[i, k] += mobility[i, j] * (moment[place] * scale)
        for i in range(n):
            drift[i] -= effect[i, k] * acting
    return drift, effect


@compiled
def _on_joints(
    gear: Array, positions: NDArray[Any], velocities: NDArray[Any], qpos: Array, qvel: Array
) -> tuple[Array, Array]:
    """Length and velocity of transmissions on joints at these indices of qpos and qvel."""
    length, velocity = np.empty(len(gear)), np.empty(len(gear))
    for i in range(len(gear)):
        length[i], velocity[i] = gear[i] * qpos[positions[i]], gear[i] * qvel[velocities[i]]
    return length, velocity


class AffineActuators(Remade):
    """Gain, bias and acting control range of every actuator of a model, whose arrays are read at every call.

    Attributes:
        constants: MuJoCo's arrays that describe the actuators.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        _refuse_unsupported(model)
        self._model = m = model
        self.constants = Actuators.of(m)
        self._moment = np.zeros((model.nu, model.nv))
        self._on_joints: tuple[Array, Array, Array] | None = None
        self._joints_suffice = False

    def gain_and_bias(self, length: Array, velocity: Array) -> tuple[Array, Array]:
        """Force per control and force at zero control, shapes (nu,) and (nu,)."""
        m = self._model
        affine, biased = m.actuator_gaintype == _AFFINE_GAIN, m.actuator_biastype == _AFFINE_BIAS
        g, b = m.actuator_gainprm, m.actuator_biasprm
        gain = g[:, 0] + affine * (g[:, 1] * length + g[:, 2] * velocity)
        return gain, biased * (b[:, 0] + b[:, 1] * length + b[:, 2] * velocity)

    def moment(self, data: mujoco.MjData) -> Array:
        """Generalised force per unit actuator force, shape (nu, nv)."""
        mujoco.mju_sparse2dense(self._moment, *moment_of(data))
        return self._moment

    def acting_range(self, length: Array, velocity: Array, control_dt: float = 0.0) -> tuple[Array, Array]:
        """The controls between which the force still changes, inside ctrlrange; shapes (nu,) and (nu,).

        Zero width where an actuator is saturated over its whole ctrlrange. Length and velocity are those of the
        transmissions (m or rad, per second). The range is widened by what a speed servo's own force can shift its
        clamp within `control_dt`, s; `actuator_acc0`, acceleration per force in the reference pose, bounds how fast.
        """
        m = self._model
        if not m.actuator_forcelimited.any():
            return control_range(m)
        least, most = np.empty(m.nu), np.empty(m.nu)
        _acting_range(self.constants, length, velocity, control_dt, least, most)
        return least, most

    def motion_without_kinematics(self, qpos: Array, qvel: Array) -> tuple[Array, Array] | None:
        """Length and velocity of the transmissions where the joints alone determine every clamp, else None."""
        m = self._model
        if not m.njnt:
            return None
        if self._on_joints is None:
            depends = m.actuator_biasprm[:, 1:3].any(axis=1) | m.actuator_gainprm[:, 1:3].any(axis=1)
            depends &= m.actuator_forcelimited.astype(bool)
            depends &= (m.actuator_biastype > 0) | (m.actuator_gaintype > 0)
            scalar = np.isin(m.actuator_trntype, AT_A_JOINT)
            joint = np.where(scalar, m.actuator_trnid[:, 0], 0)
            scalar &= m.jnt_type[joint] >= int(mujoco.mjtJoint.mjJNT_SLIDE)  # slide or hinge
            self._joints_suffice = bool((scalar | ~depends).all())
            self._on_joints = (scalar * m.actuator_gear[:, 0], m.jnt_qposadr[joint], m.jnt_dofadr[joint])
        if not self._joints_suffice:
            return None
        return _on_joints(*self._on_joints, qpos, qvel)


def moment_of(data: mujoco.MjData) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Generalised force per unit actuator force, sparse: values, and counts, starts and columns of the rows."""
    places = data.moment_rownnz, data.moment_rowadr, data.moment_colind.reshape(-1)
    return data.actuator_moment.reshape(-1), *places


class Response(Remade):
    """How a machine's joints respond to its controls, at what `data` holds.

    Args:
        model: Its arrays are read at every call.
        data: Likewise.
        actuators: Of the model.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, actuators: AffineActuators) -> None:
        self._model, self._data = model, data
        motion = data.actuator_length, data.actuator_velocity, data.ctrl, data.qacc
        self._actuation = actuators.constants, *motion, *moment_of(data)
        self._units, self._mobility = np.eye(model.nv), np.empty((model.nv, model.nv))
        self._free = np.zeros(0, np.int32), np.zeros((0, model.nv)), np.zeros(0)

    def drift_and_effect(self) -> tuple[Array, Array]:
        """`qacc = drift + effect @ u`, shapes (nv,) and (nv, nu), at the present set of active contacts and limits.

        The data must be up to date. Exact for pyramidal friction cones.
        """
        m, d = self._model, self._data
        mujoco.mj_solveM(m, d, self._mobility, self._units)
        constraints, count = self._free, d.nefc
        if count:
            if mujoco.mj_isSparse(m):
                jacobian = np.zeros((count, m.nv))
                mujoco.mju_sparse2dense(jacobian, d.efc_J, d.efc_J_rownnz, d.efc_J_rowadr, d.efc_J_colind)
            else:
                jacobian = d.efc_J[: count * m.nv].reshape(
                    count, m.nv
                )  # rows of zeros are left out at its end
            constraints = d.efc_state, jacobian, d.efc_D
        return _respond(*self._actuation, self._mobility, *constraints)


@compiled
def point_motion(
    jacobian: Array, rate: Array, qvel: Array, drift: Array, effect: Array
) -> tuple[Array, Array, Array]:
    """Velocity (3,), m/s, and acceleration `a0 + A @ u`, shapes (3,) and (3, nu), m/s^2, of a point of a machine.

    Args:
        jacobian: Of the point's position, shape (3, nv).
        rate: Its time derivative, likewise.
        qvel: Shape (nv,).
        drift: `qacc = drift + effect @ u`, shape (nv,).
        effect: Likewise, shape (nv, nu).
    """
    v, a0, a = np.zeros(3), np.zeros(3), np.zeros((3, effect.shape[1]))
    for i in range(3):
        for j in range(len(qvel)):
            v[i] += jacobian[i, j] * qvel[j]
            a0[i] += jacobian[i, j] * drift[j] + rate[i, j] * qvel[j]
            for k in range(effect.shape[1]):
                a[i, k] += jacobian[i, j] * effect[j, k]
    return v, a0, a
