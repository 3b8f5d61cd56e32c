"""A forecast: what a MuJoCo model does under a held control, and under braking after it."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BRAKING = 0.5
"""Share of an actuated joint's own motion that braking takes away per control interval; more would chatter."""


class Forecast(NamedTuple):
    """The machine at k instants: after every physics substep of the forecast, one row each.

    Kinematics belong to the same instant as the positions (MuJoCo's own lag one substep behind).

    Attributes:
        qpos: Positions, shape (k, nq).
        qvel: Velocities, shape (k, nv).
        frames: Origins of the bodies' frames, shape (k, nbody, 3), m.
        axes: Their rotation matrices, shape (k, nbody, 3, 3).
        centres: Centres of mass of the bodies, shape (k, nbody, 3), m.
    """

    qpos: Array
    qvel: Array
    frames: Array
    axes: Array
    centres: Array

    def first(self, instants: int) -> "Forecast":
        """Its first instants."""
        return self if instants == len(self.qpos) else Forecast(*(part[:instants] for part in self))


class Recorder:
    """Steps a model and writes down what a forecast holds.

    Args:
        model: The plant's own.
        substeps: Physics substeps per control interval.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        self._model, self._substeps = model, substeps
        limited = model.actuator_ctrllimited.astype(bool)
        self._low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
        self._high = np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)
        # A unit force accelerates its joints by acc0 (in the reference pose), a transmission by gear times that.
        hold_s = substeps * model.opt.timestep
        gear = np.abs(model.actuator_gear).max(axis=1)
        response = model.actuator_acc0 * gear * np.abs(model.actuator_gainprm[:, 0]) * hold_s
        self._damping = np.where(response > 0.0, _BRAKING / np.where(response > 0.0, response, 1.0), 0.0)
        # Servos stop by their own means: one for speed when asked for none, one for position where it is.
        servo = model.actuator_biastype != int(mujoco.mjtBias.mjBIAS_NONE)
        self._damping[servo] = 0.0
        self._holds_position = servo & (model.actuator_biasprm[:, 1] != 0.0)

    def record(self, data: mujoco.MjData, control: Array, holds: int) -> Forecast:
        """Hold a control for one control interval; in the others each actuator brakes its own joints.

        Args:
            data: At the present state; it is left at the end of the forecast.
            control: Shape (nu,).
            holds: Control intervals in all, >= 1.
        """
        m = self._model
        k = holds * self._substeps
        qpos, qvel = np.empty((k, m.nq)), np.empty((k, m.nv))
        frames, axes = np.empty((k, m.nbody, 3)), np.empty((k, m.nbody, 9))
        centres = np.empty((k, m.nbody, 3))
        data.ctrl[:] = control
        last = k - 1
        for i in range(k):
            if i and i % self._substeps == 0:
                data.ctrl[:] = self._braking(data)
            mujoco.mj_step(m, data)
            qpos[i], qvel[i] = data.qpos, data.qvel
            if i:  # the kinematics in data are still those of the instant before
                frames[i - 1], axes[i - 1], centres[i - 1] = data.xpos, data.xmat, data.xipos
        mujoco.mj_kinematics(m, data)
        frames[last], axes[last], centres[last] = data.xpos, data.xmat, data.xipos
        return Forecast(qpos, qvel, frames, axes.reshape(k, m.nbody, 3, 3), centres)

    def _braking(self, data: mujoco.MjData) -> Array:
        """Read once per control interval, as a controller would."""
        control = -self._damping * data.actuator_velocity
        if self._holds_position.any():
            control = np.where(self._holds_position, data.actuator_length, control)
        return np.minimum(np.maximum(control, self._low), self._high)
