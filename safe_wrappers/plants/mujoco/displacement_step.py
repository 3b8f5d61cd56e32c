"""What gymnasium-robotics' Fetch envs do to their data with an action, and which envs are of that kind."""

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.plants.mujoco.forecast import Recorder

# The envs add the turn to the gripper's quaternion (w, x, y, z): MuJoCo makes a unit quaternion of the sum.
_TURN = np.array([1.0, 0.0, 1.0, 0.0])
_FINGERS = (
    "robot0:l_gripper_finger_joint",
    "robot0:r_gripper_finger_joint",
)  # zeroed if the gripper is blocked


def moves_by_displacement(raw: Any) -> bool:
    """Whether an unwrapped env is of the Fetch kind: one mocap body welded to the gripper, four actions."""
    model, space = getattr(raw, "model", None), getattr(raw, "action_space", None)
    return (
        isinstance(model, mujoco.MjModel)
        and isinstance(space, gym.spaces.Box)
        and space.shape == (4,)
        and hasattr(raw, "block_gripper")
        and hasattr(raw, "n_substeps")
        and len(welds(model)) == model.nmocap == 1
    )


def welds(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Mocap bodies (their mocap ids) and the bodies welded to them."""
    weld = model.eq_type == int(mujoco.mjtEq.mjEQ_WELD)
    pairs = zip(model.eq_obj1id[weld].tolist(), model.eq_obj2id[weld].tolist(), strict=True)
    mocap = model.body_mocapid.tolist()
    both = (pair for first, second in pairs for pair in ((first, second), (second, first)))
    return [(mocap[one], other) for one, other in both if mocap[one] >= 0 and mocap[other] < 0]


class DisplacementRecorder(Recorder):
    """Forecasts under displacements of the gripper; braking is a displacement of zero.

    Args:
        model, data, substeps: As in `Recorder`.
        metres_per_unit: Displacement of an action of 1, m.
        dtype: Of the env's actions; the env scales them in this precision.
        blocked: Whether the env keeps the fingers closed.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        substeps: int,
        metres_per_unit: float,
        dtype: Any,
        blocked: bool,
    ) -> None:
        super().__init__(model, data, substeps)
        (self._mocap, self._gripper), *_ = welds(model)
        self._scale, self._dtype = metres_per_unit, dtype
        fingers = [model.joint(name) for name in _FINGERS] if blocked else []
        self._closed = np.array([int(joint.qposadr[0]) for joint in fingers], dtype=np.intp)
        self._servoed = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self._servo_acts = 0.0 if blocked else 1.0

    def act(self, data: mujoco.MjData, control: Array) -> None:
        """Move the mocap body from where MuJoCo last evaluated the gripper; set the finger servos' targets."""
        step = control.astype(self._dtype)
        data.mocap_pos[self._mocap] = data.xpos[self._gripper] + self._scale * step[:3]
        data.mocap_quat[self._mocap] = data.xquat[self._gripper] + _TURN
        data.ctrl[:] = data.qpos[self._servoed] + self._servo_acts * step[3]

    def settle(self, data: mujoco.MjData) -> None:
        """Put a blocked gripper's fingers back to zero, and update the poses."""
        if self._closed.size:
            data.qpos[self._closed] = 0.0
            mujoco.mj_kinematics(self._model, data)

    def brake(self, data: mujoco.MjData) -> None:
        """Leave the gripper where it is."""
        self.act(data, np.zeros(4))

    def braking(self, data: mujoco.MjData) -> Array:
        """No displacement, shape (4,)."""
        return np.zeros(4)
