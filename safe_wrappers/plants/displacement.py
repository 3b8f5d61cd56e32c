"""DisplacementPlant: an arm whose action is a displacement of its gripper, as in gymnasium-robotics' Fetch envs."""

from typing import Any, ClassVar, NoReturn

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.errors import Array, UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import moves_by_displacement, welds
from safe_wrappers.plants.mujoco.forecast import Recorder
from safe_wrappers.plants.mujoco.plant import MujocoPlant

# The envs add the turn to the gripper's quaternion (w, x, y, z): MuJoCo makes a unit quaternion of the sum.
_TURN = np.array([1.0, 0.0, 1.0, 0.0])
_METRES_PER_UNIT = 0.05
_FINGERS = tuple(f"robot0:{side}_gripper_finger_joint" for side in "lr")  # zeroed if the gripper is blocked


class DisplacementRecorder(Recorder):
    """A `Recorder` of displacements of the gripper; braking is a displacement of zero.

    The env scales actions in the precision of `dtype`; `blocked` says whether it keeps the fingers closed.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, substeps: int, dtype: Any, blocked: bool
    ) -> None:
        super().__init__(model, data, substeps)
        (self._mocap, self._gripper), *_ = welds(model)
        self._dtype = dtype
        fingers = [model.joint(name) for name in _FINGERS] if blocked else []
        self._closed = np.array([int(joint.qposadr[0]) for joint in fingers], dtype=np.intp)
        self._servoed = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self._servo_acts = 0.0 if blocked else 1.0

    def act(self, data: mujoco.MjData, control: Array) -> None:
        """Move the mocap body from where MuJoCo last evaluated the gripper; set the finger servos' targets."""
        step = control.astype(self._dtype)
        data.mocap_pos[self._mocap] = data.xpos[self._gripper] + _METRES_PER_UNIT * step[:3]
        data.mocap_quat[self._mocap] = data.xquat[self._gripper] + _TURN
        data.ctrl[:] = data.qpos[self._servoed] + self._servo_acts * step[3]

    def settle(self, data: mujoco.MjData) -> bool:
        """Put a blocked gripper's fingers back to zero, and update the poses."""
        if self._closed.size:
            data.qpos[self._closed] = 0.0
            mujoco.mj_kinematics(self._model, data)
        return bool(self._closed.size)

    def brake(self, data: mujoco.MjData) -> None:
        self.act(data, np.zeros(4))

    def braking(self, data: mujoco.MjData) -> Array:
        """No displacement, shape (4,)."""
        return np.zeros(4)


class DisplacementPlant(MujocoPlant):
    """Actions `(dx, dy, dz, fingers)` in [-1, 1] that move a mocap body, which pulls the gripper after it.

    The plant repeats the env's own step on data of its own: for actions in the action space's dtype forecasts are
    exact, bit for bit; others are rounded to it first. `f`, `g`, `acceleration` and `point` raise: constraints that
    forecast can be used, those that need rows cannot. Braking is a displacement of zero. An action of 1 is 0.05 m.

    Attributes:
        gripper: Name of the body that the mocap body pulls.
        blocked: Whether the env keeps the fingers closed; then the last entry of an action has no effect.

    Raises:
        UnsupportedEnvError: Not an env of the Fetch kind.
    """

    has_acceleration: ClassVar[bool] = False
    _sends_controls: ClassVar[bool] = False  # controls follow from where the gripper is
    _recorder: DisplacementRecorder

    def __init__(self) -> None:
        super().__init__()

    def bind(self, env: gym.Env[Any, Any]) -> None:
        raw: Any = env.unwrapped
        if not moves_by_displacement(raw):
            raise UnsupportedEnvError(
                f"{raw} is not moved by displacements of its gripper: expected one mocap body welded to one body of "
                "the arm, four actions, n_substeps and block_gripper, as in FetchReach; for a MuJoCo env whose "
                "actions are its controls take MujocoPlant()"
            )
        self._dtype = env.action_space.dtype
        self.blocked = bool(raw.block_gripper)
        self._pose = np.zeros(7)
        self._body = welds(raw.model)[0][1]
        super().bind(env)
        self.gripper = self.model.body(self._body).name

    def _take_model(self) -> None:
        super()._take_model()
        self._clamped = False  # all of the action space acts

    def _bind_actions(self, env: gym.Env[Any, Any]) -> None:
        space: Any = env.action_space
        self.lower, self.upper = (np.asarray(end, dtype=np.float64) for end in (space.low, space.high))

    def _new_recorder(self) -> DisplacementRecorder:
        return DisplacementRecorder(self.model, self.data, self.substeps, self._dtype, self.blocked)

    def observe(self) -> None:
        data: mujoco.MjData = self._raw.data
        self._pose[:3], self._pose[3:] = data.xpos[self._body], data.xquat[self._body]
        super().observe()

    def _load_to_step(self) -> None:
        super()._load_to_step()
        self.data.xpos[self._body], self.data.xquat[self._body] = self._pose[:3], self._pose[3:]

    def _linearise(self) -> None:
        mujoco.mj_forward(self.model, self.data)

    @property
    def acceleration(self) -> tuple[Array, Array]:
        """Raises, as `f`, `g` and `point` do; `motion` has position and velocity."""
        self.require_acceleration("`f`, `g`, `acceleration` or `point`")

    def require_acceleration(self, asker: str) -> NoReturn:
        """Raise an error that says what can be used instead."""
        raise UnsupportedEnvError(
            f"{asker} needs the acceleration that an action causes; on a DisplacementPlant an action is a "
            "displacement of the gripper, from which none follows. Constraints that forecast work: Workspace, "
            "JointPositionLimit, JointSpeedLimit, SpeedLimit, SingularityMargin"
        )
