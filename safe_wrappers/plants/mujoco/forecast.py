"""A forecast: what a MuJoCo model does under a held control, and under braking after it."""

from typing import NamedTuple

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.plants.mujoco.model import control_range

_BRAKING = 0.5
"""Share of an actuated joint's own motion that braking takes away per control interval; more would chatter."""
RESETS = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
"""The warnings after which MuJoCo resets the state."""


class Poses(NamedTuple):
    """Where the bodies are at k instants."""

    frames: Array  # origins of the bodies' frames, shape (k, nbody, 3), m
    axes: Array  # rotation matrices of the frames, shape (k, nbody, 3, 3)
    centres: Array  # centres of mass, shape (k, nbody, 3), m


class Forecast:
    """The machine after every physics substep of a forecast.

    Attributes:
        qpos, qvel: Positions, shape (k, nq), and velocities, shape (k, nv); NaN from the control interval on in which
            MuJoCo had to reset the state.
        published_frames, published_centres: `data.xpos` and `data.xipos` as MuJoCo leaves them at the end of every
            control interval, shapes (holds, nbody, 3), m. They lag behind the state: by one substep after Euler
            steps, to the last stage after Runge-Kutta steps.
    """

    def __init__(self, recorder: "Recorder", qpos: Array, qvel: Array, frames: Array, centres: Array) -> None:
        self._recorder, self.qpos, self.qvel = recorder, qpos, qvel
        self.published_frames, self.published_centres = frames, centres
        self._poses: dict[int, Poses] = {}

    def poses(self, every: int = 1) -> Poses:
        """Poses of the states after every `every`-th substep, computed once."""
        if every not in self._poses:
            self._poses[every] = self._recorder.poses(self.qpos[every - 1 :: every])
        return self._poses[every]

    def first(self, horizon: int) -> "Forecast":
        """Its first control intervals."""
        if horizon == len(self.published_frames):
            return self
        k = len(self.qpos) // len(self.published_frames) * horizon
        published = self.published_frames[:horizon], self.published_centres[:horizon]
        return Forecast(self._recorder, self.qpos[:k], self.qvel[:k], *published)


class Recorder:
    """Steps the plant's own model and keeps what a forecast holds; `substeps` are those of a control interval.

    Attributes:
        held: Data at the end of the latest forecast's first control interval.
        held_control: Bytes of the control of that interval; empty: there is none from the present state.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        self._model, self._substeps = model, substeps
        self.held, self.held_control = mujoco.MjData(model), b""
        self._still = mujoco.MjData(model)
        self._low, self._high = control_range(model)
        # A unit force accelerates its joints by acc0 (in the reference pose), a transmission by gear times that.
        control_dt = substeps * model.opt.timestep
        gain, gear = model.actuator_gainprm[:, 0], np.abs(model.actuator_gear).max(axis=1)
        response = model.actuator_acc0 * gear * gain * control_dt
        acts = response != 0.0
        self._damping = np.where(acts, _BRAKING / np.where(acts, response, 1.0), 0.0)
        # At rest a servo must push neither way: a position servo's target is where it is, a speed servo's is zero.
        biased = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
        bias = np.where(biased[:, None], model.actuator_biasprm[:, :3], 0.0)
        self._rest = -bias[:, :2] / np.where(acts, gain, 1.0)[:, None]
        self._damping[bias[:, 2] != 0.0] = 0.0  # it has damping of its own

    def record(
        self, data: mujoco.MjData, control: Array, horizon: int, first: Forecast | None = None
    ) -> Forecast:
        """Hold a control, shape (nu,), for one control interval; in the others each actuator brakes its own joints.

        `data` starts at the present state and is left at the end, after `horizon` >= 1 control intervals. With
        `first`, the forecast of `held_control` over one interval, it goes on from there.
        """
        m, n = self._model, self._substeps
        qpos, qvel = np.empty((horizon * n, m.nq)), np.empty((horizon * n, m.nv))
        frames, centres = np.empty((horizon, m.nbody, 3)), np.empty((horizon, m.nbody, 3))
        if first is None:
            data.warning.number[RESETS] = 0
            self.place(data)
        else:
            mujoco.mj_copyData(data, m, self.held)
            qpos[:n], qvel[:n] = first.qpos, first.qvel
            frames[:1], centres[:1] = first.published_frames, first.published_centres
        q, v = data.qpos, data.qvel  # views, which stay valid
        for hold in range(0 if first is None else 1, horizon):
            self.act(data, self.braking(data) if hold else control)
            for i in range(hold * n, hold * n + n):
                mujoco.mj_step(m, data)
                if i == hold * n + n - 1:
                    self.settle(data)
                qpos[i], qvel[i] = q, v
            frames[hold], centres[hold] = data.xpos, data.xipos
            if hold == 0:
                mujoco.mj_copyData(self.held, m, data)
                self.held_control = control.tobytes()
            if data.warning.number[RESETS].any():
                # After a reset, MuJoCo's response to numbers out of bounds, all numbers may look plausible.
                qpos[hold * n :] = qvel[hold * n :] = frames[hold:] = centres[hold:] = np.nan
                break
        return Forecast(self, qpos, qvel, frames, centres)

    def act(self, data: mujoco.MjData, control: Array) -> None:
        """Give the machine a control, as its env does at the start of a control interval."""
        data.ctrl[:] = control

    def settle(self, data: mujoco.MjData) -> None:
        """What the env does to its data at the end of a control interval."""

    def braking(self, data: mujoco.MjData) -> Array:
        """Every actuator against its own motion, shape (nu,); read once per control interval, as controllers do."""
        at_rest = self._rest[:, 0] + self._rest[:, 1] * data.actuator_length
        control = at_rest - self._damping * data.actuator_velocity
        return np.asarray(np.minimum(np.maximum(control, self._low), self._high))

    def place(self, data: mujoco.MjData) -> None:
        """Take the places of mocap bodies, which positions do not determine, for later calls of `poses`."""
        if self._model.nmocap:
            self._still.mocap_pos[:], self._still.mocap_quat[:] = data.mocap_pos, data.mocap_quat

    def poses(self, qpos: Array) -> Poses:
        """Forward kinematics of positions of shape (k, nq)."""
        m, data, k = self._model, self._still, len(qpos)
        poses = Poses(np.empty((k, m.nbody, 3)), np.empty((k, m.nbody, 3, 3)), np.empty((k, m.nbody, 3)))
        for i, q in enumerate(qpos):
            data.qpos[:] = q
            mujoco.mj_kinematics(m, data)
            poses.frames[i], poses.centres[i] = data.xpos, data.xipos
            poses.axes[i] = data.xmat.reshape(-1, 3, 3)
        return poses
