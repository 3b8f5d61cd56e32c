"""MuJoCo actuators as an affine map from control to force; those that are none are refused by name.

`force = gain * ctrl + bias`, `gain = g0 + g1 length + g2 velocity`, likewise `bias`, clamped to `forcerange`. Beyond
the clamp more control changes nothing, so it becomes a bound on the control.
"""

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.model import control_range, inertia

_JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
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
    # Not nu: from MuJoCo 3.12 on an actuator may have no control at all.
    for i in range(len(model.actuator_trntype)):
        name = model.actuator(i).name or f"#{i}"
        for what, field, kinds, handled in _HANDLED:
            kind = kinds(int(getattr(model, field)[i])).name.partition("_")[2].lower()
            if kind not in handled:
                _refuse(name, f"{what} {kind}", ", ".join(handled))
        if hasattr(model, "actuator_delay") and model.actuator_delay[i] > 0.0:
            _refuse(name, f"a delay of {model.actuator_delay[i]} s", "none (say delay_s instead)")
    for kind, limited in (("joint", model.jnt_actfrclimited), ("tendon", model.tendon_actfrclimited)):
        if limited.any():
            name = getattr(model, kind)(int(np.flatnonzero(limited)[0])).name
            raise UnsupportedEnvError(
                f"{kind} {name!r} clamps the sum of its actuators' forces (actuatorfrcrange), which MujocoPlant "
                "does not model; give the actuators a forcerange instead, or use AnalyticPlant"
            )


def _refuse(actuator: str, what: str, handled: str) -> None:
    raise UnsupportedEnvError(
        f"actuator {actuator!r} has {what}, which MujocoPlant cannot write as f(x) + g(x) u; it handles: "
        f"{handled}. Use AnalyticPlant with your own f and g."
    )


@compiled
def _acting_range(
    gain_type: NDArray[Any],
    gain: Array,
    bias_type: NDArray[Any],
    bias: Array,
    force_limited: NDArray[Any],
    force_range: Array,
    control_limited: NDArray[Any],
    control_range: Array,
    gear: Array,
    acceleration: Array,
    length: Array,
    velocity: Array,
    control_dt: float,
    least: Array,
    most: Array,
) -> None:
    """Writes `AffineActuators.acting_range` into `least` and `most`; the arrays are MuJoCo's of the actuators."""
    for i in range(len(least)):
        low, high = -math.inf, math.inf
        if control_limited[i]:
            low, high = control_range[i, 0], control_range[i, 1]
        scale, offset = gain[i, 0], 0.0
        if gain_type[i] == _AFFINE_GAIN:
            scale += gain[i, 1] * length[i] + gain[i, 2] * velocity[i]
        if bias_type[i] == _AFFINE_BIAS:
            offset = bias[i, 0] + bias[i, 1] * length[i] + bias[i, 2] * velocity[i]
        least[i], most[i] = low, high
        if force_limited[i] and scale != 0.0:
            ends = (force_range[i, 0] - offset) / scale, (force_range[i, 1] - offset) / scale
            feedback = abs(bias[i, 2]) if bias_type[i] == _AFFINE_BIAS else 0.0
            strongest = max(abs(force_range[i, 0]), abs(force_range[i, 1]))
            lever = 0.0
            for j in range(gear.shape[1]):
                lever = max(lever, abs(gear[i, j]))
            widen = feedback * (lever * acceleration[i] * strongest * control_dt) / abs(scale)
            least[i] = min(max(min(ends[0], ends[1]) - widen, low), high)
            most[i] = min(max(max(ends[0], ends[1]) + widen, low), high)


@compiled
def _drive(
    gain_type: NDArray[Any],
    gain: Array,
    bias_type: NDArray[Any],
    bias: Array,
    force_limited: NDArray[Any],
    force_range: Array,
    control_limited: NDArray[Any],
    control_range: Array,
    gear: Array,
    acceleration: Array,
    length: Array,
    velocity: Array,
    control: Array,
    moment: Array,
    acting: Array,
) -> None:
    """Turns `moment` into the generalised force per control, none where saturated; `acting` takes what acts of it."""
    least, most = np.empty(len(acting)), np.empty(len(acting))
    _acting_range(
        gain_type,
        gain,
        bias_type,
        bias,
        force_limited,
        force_range,
        control_limited,
        control_range,
        gear,
        acceleration,
        length,
        velocity,
        0.0,
        least,
        most,
    )
    for i in range(len(acting)):
        scale = gain[i, 0]
        if gain_type[i] == _AFFINE_GAIN:
            scale += gain[i, 1] * length[i] + gain[i, 2] * velocity[i]
        if most[i] <= least[i]:
            scale = acting[i] = 0.0
        else:
            acting[i] = min(max(control[i], least[i]), most[i])
        for j in range(moment.shape[1]):
            moment[i, j] *= scale


@compiled
def _split(qacc: Array, response: Array, acting: Array) -> tuple[Array, Array]:
    """`drift` and `effect` of `qacc = drift + effect @ acting`; `response` is the effect's transpose."""
    drift, effect = qacc.copy(), np.empty((response.shape[1], response.shape[0]))
    for j in range(response.shape[1]):
        pushed = 0.0
        for i in range(response.shape[0]):
            effect[j, i] = response[i, j]
            pushed += response[i, j] * acting[i]
        drift[j] -= pushed
    return drift, effect


class AffineActuators:
    """Gain, bias and acting control range of every actuator of a model, whose arrays are read at every call."""

    def __init__(self, model: mujoco.MjModel) -> None:
        _refuse_unsupported(model)
        self._model = m = model
        self._constants = (
            *(m.actuator_gaintype, m.actuator_gainprm, m.actuator_biastype, m.actuator_biasprm),
            *(m.actuator_forcelimited, m.actuator_forcerange, m.actuator_ctrllimited, m.actuator_ctrlrange),
            *(m.actuator_gear, m.actuator_acc0),
        )
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
        places = data.moment_rownnz, data.moment_rowadr, data.moment_colind.reshape(-1)
        mujoco.mju_sparse2dense(self._moment, data.actuator_moment.reshape(-1), *places)
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
        _acting_range(*self._constants, length, velocity, control_dt, least, most)
        return least, most

    def forces(self, data: mujoco.MjData) -> tuple[Array, Array]:
        """Generalised force per control, shape (nu, nv), and what acts of the data's control, shape (nu,)."""
        acting, moment = np.empty(len(self._moment)), self.moment(data)
        motion = data.actuator_length, data.actuator_velocity
        _drive(*self._constants, *motion, data.ctrl, moment, acting)
        return moment, acting

    def motion_without_kinematics(self, qpos: Array, qvel: Array) -> tuple[Array, Array] | None:
        """Length and velocity of the transmissions where the joints alone determine every clamp, else None."""
        m = self._model
        if self._on_joints is None:
            depends = m.actuator_biasprm[:, 1:3].any(axis=1) | m.actuator_gainprm[:, 1:3].any(axis=1)
            depends &= m.actuator_forcelimited.astype(bool)
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


def drift_and_effect(
    model: mujoco.MjModel, data: mujoco.MjData, actuators: AffineActuators
) -> tuple[Array, Array]:
    """`qacc = drift + effect @ u`, shapes (nv,) and (nv, nu), at the present set of active contacts and limits.

    The data must be up to date. Exact for pyramidal friction cones.
    """
    forces, acting = actuators.forces(data)
    return _split(data.qacc, _solve_inertia(model, data, forces), acting)


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


@compiled
def _solve_stiff(inertia: Array, state: NDArray[Any], jacobian: Array, stiffness: Array, rows: Array) -> None:
    """Divides `rows`, shape (nu, nv), by the inertia with its active constraints, by a Cholesky decomposition."""
    n = len(inertia)
    for row in range(len(state)):
        if state[row] == _QUADRATIC:
            for i in range(n):
                pull = stiffness[row] * jacobian[row, i]
                for j in range(i + 1 if pull != 0.0 else 0):
                    inertia[i, j] += pull * jacobian[row, j]
    for i in range(n):
        for j in range(i + 1):
            left = inertia[i, j]
            for k in range(j):
                left -= inertia[i, k] * inertia[j, k]
            if i > j:
                inertia[i, j] = left / inertia[j, j]
            else:
                inertia[i, i] = math.sqrt(left) if left > 0.0 else math.nan
    for row in range(len(rows)):
        for i in range(n):
            for k in range(i):
                rows[row, i] -= inertia[i, k] * rows[row, k]
            rows[row, i] /= inertia[i, i]
        for back in range(n):
            i = n - 1 - back
            for k in range(i + 1, n):
                rows[row, i] -= inertia[k, i] * rows[row, k]
            rows[row, i] /= inertia[i, i]


def _solve_inertia(m: mujoco.MjModel, d: mujoco.MjData, rows: Array) -> Array:
    """`rows @ inv(M + J_a' D_a J_a)`: accelerations per generalised force with the active constraints."""
    out, count = np.empty_like(rows), d.nefc
    if not (count and (d.efc_state == _QUADRATIC).any()):
        mujoco.mj_solveM(m, d, out, rows)
        return out
    if mujoco.mj_isSparse(m):
        jacobian = np.zeros((count, m.nv))
        mujoco.mju_sparse2dense(jacobian, d.efc_J, d.efc_J_rownnz, d.efc_J_rowadr, d.efc_J_colind)
    else:
        jacobian = d.efc_J.reshape(count, m.nv)
    out[:] = rows
    _solve_stiff(inertia(m, d), d.efc_state, jacobian, d.efc_D, out)
    return out
