"""Reaching with elastic joints: torque steps ring, so a policy's seams show as vibration."""

import math
from typing import Any, Final

import mujoco
import numpy as np
from gymnasium.utils import EzPickle

from safe_wrappers.errors import Array
from safe_wrappers.info import COST, COST_SUBSTEP, IS_SUCCESS

from .field import METADATA, TaskEnv

SUCCESS_RADIUS: Final = 0.03
"""m."""
TORQUE_RATING: Final = (4.0, 1.5)
"""N m: what the joints' springs may carry before it costs. The motors' full torque takes the rigid arm to at most
2.5 and 0.8 at rest; a step of full torque makes the springs ring to nearly twice that."""

_FRAME_SKIP: Final = 10
_TORQUE_PRICE: Final = 0.01  # of the reward, per squared share of the full torque
_START: Final = (0.0, 1.5)  # rad, the motors: the elbow bent
_START_SPREAD: Final = 0.1  # rad
_TARGET_RADII: Final = (0.2, 0.55)  # m from the base; the arm reaches 0.6
_CAMERA: Final = {"distance": 1.6, "elevation": -60.0, "azimuth": 90.0, "lookat": np.zeros(3)}


MOTORS: Final = slice(0, None, 2)
"""The motors' coordinates; the model's are motor 0, spring 0, motor 1, spring 1."""
SPRINGS: Final = slice(1, None, 2)
"""The springs' coordinates."""


class FlexibleArm:
    """The constants of the planar two-link arm and its joints; the link angles are q0 and, relative to it, q1.

    Link inertia: M(q) = [[`inertia` + 2 `coupling` cos q1, `forearm` + `coupling` cos q1], [the same, `forearm`]],
    kg m^2, about the base with the elbow at a right angle, and of the forearm about the elbow. Of both joints, shape
    (2,): `lengths` (m), `rotor_inertia` (kg m^2, reflected to the link side), `stiffness` (N m/rad), `motor_damping`
    and `joint_damping` (N m s/rad, of the motor and across the spring).
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        data, found = mujoco.MjData(model), []
        for angle in (0.0, math.pi / 2.0):
            data.qpos[:] = 0.0, 0.0, angle, 0.0
            mujoco.mj_forward(model, data)
            columns = np.zeros((model.nv, model.nv))
            for column, unit in zip(columns, np.eye(model.nv), strict=True):
                mujoco.mj_mulM(model, data, column, unit)
            found.append(columns[SPRINGS, SPRINGS])  # no rotor's inertia acts on the springs' coordinates
        straight, bent = found
        self.inertia = float(bent[0, 0])
        self.coupling = float(straight[0, 1] - bent[0, 1])
        self.forearm = float(bent[1, 1])
        self.lengths = np.array([model.body("forearm").pos[0], model.site("fingertip").pos[0]])
        self.rotor_inertia = model.dof_armature[MOTORS].copy()
        self.stiffness = model.jnt_stiffness[SPRINGS].copy()
        self.motor_damping = model.dof_damping[MOTORS].copy()
        self.joint_damping = model.dof_damping[SPRINGS].copy()

    def fingertip(self, q: Array) -> Array:
        """Position of the fingertip at link angles, shape (..., 2), in the plane; shape (..., 2), m."""
        first, both = q[..., 0], q[..., 0] + q[..., 1]
        l0, l1 = self.lengths
        return np.stack(
            [l0 * np.cos(first) + l1 * np.cos(both), l0 * np.sin(first) + l1 * np.sin(both)], axis=-1
        )

    def vibration_energy(self, qpos: Array, qvel: Array, torque: Array) -> Array:
        """Boundary-layer energy, shape (...,), J, of states of shape (..., 4) with the motors' torque held.

        What would ring on if the torque stayed as it is, written out for two joints because every physics substep
        asks; the tests compare it with the same from matrices. With the rigid arm's acceleration a, from
        (M + J) a = u - h with u = torque - B motor speed and h the links' bias, the springs' quasi-steady torque is
        z0 = u - J a.
        """
        j0, j1 = self.rotor_inertia.tolist()
        k0, k1 = self.stiffness.tolist()
        b0, b1 = self.motor_damping.tolist()
        t0, t1 = torque.tolist()
        _, p0, q2, p1 = qpos.T
        v0, r0, v1, r1 = qvel.T
        elbow = q2 + p1
        cos, sin = self.coupling * np.cos(elbow), self.coupling * np.sin(elbow)
        n00, n01, n11 = j0 + self.inertia + 2.0 * cos, self.forearm + cos, j1 + self.forearm
        speed0, speed1 = v0 + r0, v1 + r1
        u0, u1 = t0 - b0 * v0, t1 - b1 * v1
        f0 = u0 + sin * speed1 * (2.0 * speed0 + speed1)
        f1 = u1 - sin * speed0 * speed0
        share = 1.0 / (n00 * n11 - n01 * n01)
        # z0 - z, as the springs' angles are link - motor.
        x0 = k0 * p0 + u0 - j0 * share * (n11 * f0 - n01 * f1)
        x1 = k1 * p1 + u1 - j1 * share * (n00 * f1 - n01 * f0)
        w0, w1 = j0 * r0, j1 * r1
        stored = x0 * x0 / k0 + x1 * x1 / k1
        moving = w0 * r0 + w1 * r1 - share * (n11 * w0 * w0 - 2.0 * n01 * w0 * w1 + n00 * w1 * w1)
        energy: Array = 0.5 * (stored + moving)
        return energy.T  # the first transpose turned all leading axes round


class FlexJointReachEnv(TaskEnv):
    """A level two-link arm with elastic joints reaches for a target: Reacher with real torques and gears that ring.

    Each joint is a motor and a link with a spring between them (Spong 1987): two inertias per joint, resonances
    from 10 to 19 Hz over the poses, damping ratios from 0.006 to 0.017. A torque step rings on for about a second,
    and the env says how much.

    **Action**: motor torques, N m, ``Box([-3, -1], [3, 1], (2,), float32)``, held for 0.01 s (ten physics substeps).
    Torques beyond it are clipped by the motors.

    **Observation**, float64, shape (14,): cosines (2) and sines (2) of the motor angles, motor velocities (2,
    rad/s), deflections motor - link (2, rad) and their rates (2, rad/s), target x, y (m), fingertip - target x, y
    (m).

    **Reward**: Reacher's form: less the distance to the target at the step's end (m), less 0.01 times the sum over
    the motors of (torque / largest torque)^2. Vibration costs no reward.

    **Start**: at rest, springs relaxed, the motors within 0.1 rad of (0, 1.5); the target uniform over the ring
    between 0.2 and 0.55 m from the base. An episode never terminates; `gymnasium.make` truncates it after
    200 steps.

    **Info**, at every step and at reset: ``vibration_energy`` (J; see `FlexibleArm.vibration_energy`) and
    ``deflection`` (rad, between a motor and its link), the largest at the ends of the step's physics substeps;
    ``tracking_error`` (m, from the fingertip to the target at the step's end), ``is_success``, the reward's shares
    ``reward_dist`` and ``reward_ctrl``, and ``cost`` with its equal ``cost_substep``: 1.0 if a spring carried more
    than `TORQUE_RATING` at the end of any substep, else 0.0. At reset they judge the start state.

    Args:
        kwargs: Passed to `gymnasium.envs.mujoco.MujocoEnv`.

    Example:
        >>> import gymnasium as gym, safe_wrappers
        >>> env = gym.make("FlexJointReach-v0")
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.high)[4]
        >>> info["vibration_energy"] > 0.01
        True
    """

    metadata: dict[str, Any] = {**METADATA, "render_fps": 100}  # noqa: RUF012 (Gymnasium's)

    def __init__(self, **kwargs: Any) -> None:
        EzPickle.__init__(self, **kwargs)
        super().__init__("flex_joint_reach.xml", _FRAME_SKIP, 14, _CAMERA, **kwargs)
        self.arm = FlexibleArm(self.model)
        self._rating = np.array(TORQUE_RATING)
        self._full_torque = self.model.actuator_ctrlrange[:, 1].copy()
        self._target = np.array(self.data.mocap_pos[0, :2])
        self._judge_now()

    @property
    def target_position(self) -> Array:
        """Target in the plane, shape (2,), m."""
        return self._target.copy()

    @property
    def fingertip_position(self) -> Array:
        """Fingertip in the plane, shape (2,), m; from qpos, so never a substep behind."""
        qpos = self.data.qpos
        return self.arm.fingertip(qpos[MOTORS] + qpos[SPRINGS])

    def place_target(self, target: Array) -> None:
        """Move the target to x, y, shape (2,), m."""
        self._target[:] = target
        self.data.mocap_pos[0, :2] = self._target

    def reset_model(self) -> Array:
        inner, outer = _TARGET_RADII
        radius = math.sqrt(self.np_random.uniform(inner**2, outer**2))
        angle = self.np_random.uniform(-math.pi, math.pi)
        self.place_target(np.array([radius * math.cos(angle), radius * math.sin(angle)]))
        qpos = self.init_qpos.copy()
        qpos[MOTORS] = _START + self.np_random.uniform(-_START_SPREAD, _START_SPREAD, 2)
        self.set_state(qpos, np.zeros(self.model.nv))
        return self.observe()

    def set_state(self, qpos: Array, qvel: Array) -> None:
        """Set positions and velocities (shape (4,): motor 0, spring 0, motor 1, spring 1) and judge them."""
        super().set_state(qpos, qvel)  # type: ignore[no-untyped-call]
        self._judge_now()

    def _reward(self) -> float:
        share = self.data.actuator_force / self._full_torque
        self._reward_dist = -self._distance
        self._reward_ctrl = -_TORQUE_PRICE * float(share @ share)
        return self._reward_dist + self._reward_ctrl

    def observe(self) -> Array:
        qpos, qvel = self.data.qpos, self.data.qvel
        motors = qpos[MOTORS]
        angles = [np.cos(motors), np.sin(motors), qvel[MOTORS], -qpos[SPRINGS], -qvel[SPRINGS]]
        return np.concatenate([*angles, self._target, self.fingertip_position - self._target])

    def _get_reset_info(self) -> dict[str, Any]:
        cost = float(self._overloaded)
        return {
            "vibration_energy": self._energy,
            "deflection": self._deflection,
            "tracking_error": self._distance,
            IS_SUCCESS: self._distance <= SUCCESS_RADIUS,
            "reward_dist": self._reward_dist,
            "reward_ctrl": self._reward_ctrl,
            COST: cost,
            COST_SUBSTEP: cost,
        }

    def _step_mujoco_simulation(self, ctrl: Array, n_frames: int) -> None:
        """Step substep by substep, keep every state, judge them together at the end."""
        model, data = self.model, self.data
        data.ctrl[:] = ctrl
        qpos, qvel = np.zeros((n_frames, model.nq)), np.zeros((n_frames, model.nv))
        for k in range(n_frames):
            mujoco.mj_step(model, data)
            qpos[k], qvel[k] = data.qpos, data.qvel
        self._judge(qpos, qvel)

    def _judge_now(self) -> None:
        self._reward_dist = self._reward_ctrl = 0.0
        self._judge(self.data.qpos[None], self.data.qvel[None])

    def _judge(self, qpos: Array, qvel: Array) -> None:
        """Judge consecutive states, shape (n, 4), the last of them the present one."""
        deflection = np.abs(qpos[:, SPRINGS]).max(axis=0)
        self._deflection = float(deflection.max())
        self._overloaded = not bool((deflection * self.arm.stiffness <= self._rating).all())
        self._energy = float(self.arm.vibration_energy(qpos, qvel, self.data.actuator_force).max())
        self._distance = math.dist(self.fingertip_position, self._target)
