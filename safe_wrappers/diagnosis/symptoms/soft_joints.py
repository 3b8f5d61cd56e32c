"""Joints that ring: the energy that a policy's commands leave vibrating in springs between motors and links."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, box
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, require_physics
from safe_wrappers.errors import SafeWrappersError
from safe_wrappers.plants.mujoco import model as of_model
from safe_wrappers.plants.queries.rigid_model import RigidModelCheck, rigid_model_check

SHARE = 0.0025
"""Of a full step's energy, what a ramp at the proposed rate may leave in the slowest resonance."""


def _checked(env: Env) -> tuple[mujoco.MjModel, RigidModelCheck]:
    model, _ = require_physics(env, "whose joints could be read")
    try:
        check = rigid_model_check(env.unwrapped)
    except SafeWrappersError as error:
        raise NotMeasuredError(f"the springs of this machine cannot be read: {error}") from error
    if not check.springs:
        raise NotMeasuredError("no spring lies behind a motor")
    return model, check


def _joints(model: mujoco.MjModel, check: RigidModelCheck) -> NDArray[np.intp]:
    """Of the springs, shape (n,)."""
    ids = [int(name[1:]) if name.startswith("#") else model.joint(name).id for name in check.springs]
    return np.array(ids, dtype=np.intp)


class Springs:
    """The energy in springs that is not that of the rigid machine under the same torques.

    With the springs locked the torques give an acceleration, and the springs would carry what that takes. What they
    carry more or less, and their rates, is vibration (the boundary layer of singular perturbation), exact as far as
    pose, speeds and forces of contacts hardly change within some periods.

    Args:
        model: Whose actuators have no states.
        joints: Of the springs, hinges or slides.
        low: Least controls, shape (nu,).
        high: Largest ones.
    """

    def __init__(self, model: mujoco.MjModel, joints: NDArray[np.intp], low: Array, high: Array) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._at, self._dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._rest = np.setdiff1d(np.arange(model.nv), self._dofs)
        self._stiffness = model.jnt_stiffness[joints]
        self._low, self._high = low, high

    def energies(self, qpos: Array, qvel: Array, control: Array) -> tuple[float, float]:
        """Vibration with the control held, and what full steps of all actuators leave together, J."""
        model, data, s, r = self._model, self._data, self._dofs, self._rest
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, control
        mujoco.mj_forward(model, data)
        inertia = of_model.inertia(model, data)
        carried = np.linalg.solve(
            inertia[np.ix_(r, r)], inertia[np.ix_(r, s)]
        ).T  # of a force on the rest, (n, r)
        force = data.qfrc_actuator + data.qfrc_passive + data.qfrc_constraint - data.qfrc_bias
        off = carried @ force[r] + data.qfrc_bias[s] - data.qfrc_constraint[s]
        off += self._stiffness * (qpos[self._at] - model.qpos_spring[self._at])
        moving = inertia[np.ix_(s, s)] - carried @ inertia[np.ix_(r, s)]
        rates = qvel[s]
        vibrating = 0.5 * float((off * off / self._stiffness).sum() + rates @ moving @ rates)
        full = 0.0
        for i in range(model.nu):
            step = carried @ (
                self._pushed(control, i, self._high[i]) - self._pushed(control, i, self._low[i])
            )
            full += 0.5 * float((step * step / self._stiffness).sum())
        return vibrating, full

    def _pushed(self, control: Array, actuator: int, value: float) -> Array:
        """Forces on the rest with another control of one actuator, shape (r,)."""
        self._data.ctrl[:] = control
        self._data.ctrl[actuator] = value
        mujoco.mj_fwdActuation(self._model, self._data)
        return np.array(self._data.qfrc_actuator[self._rest])


def measure(env: Env, recording: Recording) -> Measured:
    """The energy that vibrates, but for one in a hundred steps, as a share of what full steps of torque leave."""
    model, check = _checked(env)
    low, high = of_model.control_range(model)
    seen = recording.controls.min(axis=0), recording.controls.max(axis=0)
    springs = Springs(
        model,
        _joints(model, check),
        np.where(np.isfinite(low), low, seen[0]),
        np.where(np.isfinite(high), high, seen[1]),
    )
    states = zip(recording.qpos, recording.qvel, recording.controls, strict=True)
    vibrating, full = np.array([springs.energies(*state) for state in states]).T
    if not full.all():
        raise NotMeasuredError("no control reaches the springs")
    shares = np.asarray(vibrating / full)
    evidence = [
        Evidence("largest energy that vibrates", float(vibrating.max()), "J"),
        Evidence("of full steps of all actuators, median", float(np.median(full)), "J"),
        *(Evidence(f"resonance {i}", w, "rad/s") for i, w in enumerate(check.resonances)),
        *(Evidence(f"its damping ratio {i}", z, "") for i, z in enumerate(check.damping_ratios)),
        Evidence("amplitude left after a control interval", check.left_over, "share"),
    ]
    return Measured(float(np.percentile(shares, 99.0)), shares, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """A rate limit at which a ramp of any size leaves little in the slowest resonance.

    A ramp at rate r leaves at most 2 r / (w range) of the amplitude that a step of the whole range does.
    """
    _, check = _checked(env)
    chunks = (
        'If the policy gives chunks, pass them whole: ChunkHandover(env, ..., flexible="auto") blends seams.'
    )
    low, high = box(env)
    direct = recording.controls.shape == recording.actions.shape
    if not direct or not np.allclose(recording.controls, recording.executed, rtol=1e-5, atol=1e-6):
        return "", f"Let commands change more slowly than the springs ring. {chunks}"
    rates = 0.5 * check.resonances[0] * np.sqrt(SHARE) * (high - low)
    limit = ", ".join(f"{rate:.4g}" for rate in rates)
    return (
        f"env = sw.ChunkHandover(\n    env, chunk_size=1, execution_horizon=1, rate_limit=[{limit}]\n)",
        f"This limit is slow: a policy that is trained through it loses less. {chunks}",
    )


SYMPTOM = Symptom(
    "joints that ring after the commands", "section 1.3, flexible joint dynamics",
    0.02, "of a full step", ("energy that vibrates", "of a full step"), measure, lines, policies_only=True,
)  # fmt: skip
