"""InverseDynamics: the torques that position servos' joints need along a motion of their targets."""

import copy

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco import model as of_model
from safe_wrappers.plants.mujoco.action_map import refuse_mapped
from safe_wrappers.plants.mujoco.model import SCALAR_JOINTS
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_ON_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)


class InverseDynamics:
    """M q'' + bias at the joints of a plant's position servos, as if these followed their targets.

    Joints without a servo stand still where the env has them. What touches, and what limits joints, is left out.

    Args:
        plant: Bound; all its actuators are position servos on hinges or slides.

    Raises:
        UnsupportedEnvError: Other actuators, or actions that are not the model's controls.
    """

    def __init__(self, plant: MujocoPlant) -> None:
        refuse_mapped(plant.action_map, "a torque limit of position commands")
        self._plant = plant
        self._read_model()

    def _read_model(self) -> None:
        model, self._model_version = copy.copy(self._plant.model), self._plant.model_version
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self._model, self._data = model, mujoco.MjData(model)
        for i in range(model.nu):
            joint = int(model.actuator_trnid[i, 0])
            on_joint = model.actuator_trntype[i] == _ON_JOINT and model.jnt_type[joint] in SCALAR_JOINTS
            gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
            if not (on_joint and gain > 0.0 and bias[1] == -gain and bias[0] == 0.0):
                raise UnsupportedEnvError(
                    f"actuator {model.actuator(i).name or i!r} is no position servo of a hinge or slide, so its "
                    "command tells no torque: limit velocity, acceleration and jerk"
                )
        joints = model.actuator_trnid[: model.nu, 0]
        self._at, self._dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._gear = model.actuator_gear[: model.nu, 0].copy()

    def torques(self, positions: Array, velocities: Array, accelerations: Array) -> Array:
        """N m (N for slides), all shape (k, m), by `mj_inverse`: passive forces of the joints are counted."""
        torques = np.zeros_like(positions)
        self._observe()
        data = self._data
        for i in range(len(torques)):
            self._place(positions[i])
            data.qvel[:] = data.qacc[:] = 0.0
            data.qvel[self._dof] = velocities[i] / self._gear
            data.qacc[self._dof] = accelerations[i] / self._gear
            mujoco.mj_inverse(self._model, data)
            torques[i] = data.qfrc_inverse[self._dof]
        return torques

    def inertia(self, positions: Array) -> Array:
        """Of the driven joints per command, at positions (k, m), shape (k, m, m), kg m^2 (kg for slides)."""
        found = np.zeros((*positions.shape, positions.shape[1]))
        self._observe()
        for matrix, position in zip(found, positions, strict=True):
            self._place(position)
            mujoco.mj_fwdPosition(self._model, self._data)
            matrix[:] = of_model.inertia(self._model, self._data)[np.ix_(self._dof, self._dof)] / self._gear
        return found

    def _observe(self) -> None:
        self._plant.observe()
        if self._plant.model_version != self._model_version:
            self._read_model()

    def _place(self, position: Array) -> None:
        self._data.qpos[:] = self._plant.state[: self._model.nq]
        self._data.qpos[self._at] = position / self._gear
