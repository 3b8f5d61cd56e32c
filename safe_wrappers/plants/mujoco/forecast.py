"""The trajectory of a MuJoCo model under a held control, and under braking after it."""

from typing import Final, NamedTuple

import mujoco
import numpy as np

from safe_wrappers.errors import Array
from safe_wrappers.plants.mujoco.binding import ActionMap
from safe_wrappers.plants.mujoco.model import RESETS, Remade, control_range
from safe_wrappers.plants.plant import Trajectory

_BRAKING = 0.5
"""Share of an actuated joint's own motion that braking takes away per control interval; more would chatter."""
_NONE: Final = bytes(4 * (RESETS.stop - RESETS.start))
"""The counts of these warnings where there was none."""
_EULER: Final = int(mujoco.mjtIntegrator.mjINT_EULER)
_MOTION: Final = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL)


class Poses(NamedTuple):
    """Where the bodies are at k instants."""

    frames: Array  # origins of the bodies' frames, shape (k, nbody, 3), m
    axes: Array  # rotation matrices of the frames, shape (k, nbody, 3, 3)
    centres: Array  # centres of mass, shape (k, nbody, 3), m


class MujocoTrajectory(Trajectory):
    """The machine after every physics substep.

    Attributes:
        qpos, qvel: Positions, shape (k, nq), and velocities, shape (k, nv); NaN from the control interval on in which
            MuJoCo had to reset the state.
        states: Both, shape (k, nq + nv).
        published_frames, published_centres: `data.xpos` and `data.xipos` as MuJoCo leaves them at the end of every
            control interval, shapes (holds, nbody, 3), m. They lag behind the state: by one substep after Euler
            steps, to the last stage after Runge-Kutta steps.
        published: Both, shape (holds, 2, nbody, 3), m.
    """

    def __init__(self, recorder: "Recorder", control: Array | None, states: Array, published: Array) -> None:
        super().__init__(control, states, max(1, len(published)))
        self._recorder, self.published = recorder, published
        nq = recorder.nq
        self.qpos, self.qvel = states[:, :nq], states[:, nq:]
        self.published_frames, self.published_centres = published[:, 0], published[:, 1]
        self._poses: dict[int, Poses] = {}

    def poses(self, every: int = 1) -> Poses:
        """Poses of the states after every `every`-th substep, computed once."""
        if every not in self._poses:
            self._poses[every] = self._recorder.poses(self.qpos[every - 1 :: every])
        return self._poses[every]

    def first(self, horizon: int) -> "MujocoTrajectory":
        """Its first control intervals."""
        if horizon == self.holds:
            return self
        k = len(self.states) // self.holds * horizon
        return MujocoTrajectory(self._recorder, self.control, self.states[:k], self.published[:horizon])


class Recorder(Remade):
    """Steps the plant's own model and keeps what a forecast holds; `substeps` are those of a control interval.

    With an `action_map` a control is the action that the env maps to the model's.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        substeps: int,
        action_map: ActionMap | None = None,
    ) -> None:
        self._model, self._data, self.substeps, self.nq = model, data, substeps, int(model.nq)
        self.is_runge_kutta = int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
        self._resets = data.warning.number[RESETS]
        self._at_end_of = b""  # the control after whose first control interval the data is
        self._still = mujoco.MjData(model)
        # A unit force accelerates its joints by acc0 (in the reference pose), a transmission by gear times that.
        control_dt = substeps * model.opt.timestep
        gain, gear = model.actuator_gainprm[:, 0], np.abs(model.actuator_gear).max(axis=1)
        response = model.actuator_acc0 * gear * gain * control_dt
        acts = response != 0.0
        damping = np.where(acts, _BRAKING / np.where(acts, response, 1.0), 0.0)
        # At rest a servo must push neither way: a position servo's target is where it is, a speed servo's is zero.
        biased = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
        bias = np.where(biased[:, None], model.actuator_biasprm[:, :3], 0.0)
        rest, per_length = -bias[:, :2].T / np.where(acts, gain, 1.0)
        damping[bias[:, 2] != 0.0] = 0.0  # it has damping of its own
        self._servos = rest, per_length, damping
        self._map = action_map
        self._low, self._high = low, high = control_range(model)
        if action_map is not None:  # brakes are as strong as actions can make them
            self._low, self._high = (np.clip(end, low, high) for end in action_map.reach())

    def record(
        self, control: Array, horizon: int, first: MujocoTrajectory | None = None, euler: bool = False
    ) -> MujocoTrajectory:
        """Hold a control, shape (nu,), for one control interval; in the others each actuator brakes its own joints.

        The data starts at the present state and is left at the end, after `horizon` >= 1 control intervals. With
        `first`, its trajectory over one interval, it goes on from there: see `goes_on`. With `euler` the intervals
        that brake are simulated by Euler steps, where the model's own are Runge-Kutta's, which cost four.
        """
        path, published = self._empty(horizon)
        if first is None:
            self._begin(control)
            whole = self.simulate(0, 1, path, published)
        else:
            whole = 1
            path[: self.substeps], published[:1] = first.states, first.published
        if whole and horizon > 1:
            whole = (self._by_euler_steps if euler else self.simulate)(1, horizon, path, published)
        self._at_end_of = control.tobytes() if whole == horizon == 1 else b""
        return self._trajectory(control, path, published, whole)

    def goes_on(self, control: Array) -> bool:
        """Whether the data is still where a recording of this control over one interval has left it."""
        return self._at_end_of == control.tobytes()

    def forget(self) -> None:
        """Called when the data is at another state."""
        self._at_end_of = b""

    def sketch(self, control: Array, horizon: int) -> MujocoTrajectory:
        """A forecast as `record` makes it, but by Euler steps from the start; nothing is held."""
        path, published = self._empty(horizon)
        self._begin(control)
        whole = self._by_euler_steps(0, horizon, path, published)
        return self._trajectory(control, path, published, whole)

    def _empty(self, horizon: int) -> tuple[Array, Array]:
        m = self._model
        return np.empty((horizon * self.substeps, m.nq + m.nv)), np.empty((horizon, 2, m.nbody, 3))

    def _begin(self, control: Array) -> None:
        self._resets[:] = 0
        self.place(self._data)
        self.act(self._data, control)

    def _trajectory(self, control: Array, path: Array, published: Array, whole: int) -> MujocoTrajectory:
        if whole < len(published):
            # After a reset, MuJoCo's response to numbers out of bounds, all numbers may look plausible.
            path[whole * self.substeps :] = published[whole:] = np.nan
        return MujocoTrajectory(self, control.copy(), path, published)

    def _by_euler_steps(self, begin: int, end: int, path: Array, published: Array) -> int:
        if not self.is_runge_kutta:
            return self.simulate(begin, end, path, published)
        # Only Euler steps write these two; the env's own data have none of it.
        written = self._data.qH, self._data.qHDiagInv
        before = [part.copy() for part in written]
        option = self._model.opt
        option.integrator, own = _EULER, option.integrator
        try:
            return self.simulate(begin, end, path, published, euler=True)
        finally:
            option.integrator = own
            for part, kept in zip(written, before, strict=True):
                part[:] = kept

    def simulate(self, begin: int, end: int, path: Array, published: Array, euler: bool = False) -> int:
        """Go on with control intervals, braking in all but the first one; how many from 0 on are whole.

        Args:
            begin: The first of them; in interval 0 a control acts already.
            end: The one after the last.
            path: The states after each substep of all intervals, to be written to, shape (k, nq + nv).
            published: Likewise what the intervals' ends publish, shape (intervals, 2, nbody, 3).
            euler: The steps are Euler's in the place of Runge-Kutta's; what they publish does not lag.
        """
        m, data, n = self._model, self._data, self.substeps
        frames, centres, resets = data.xpos, data.xipos, self._resets
        for hold in range(begin, end):
            if hold:
                self.brake(data)
            states = path[hold * n : hold * n + n]
            for state in states:
                mujoco.mj_step(m, data)
                mujoco.mj_getState(m, data, state, _MOTION)
            if self.settle(data):
                mujoco.mj_getState(m, data, states[-1], _MOTION)
            if euler:
                mujoco.mj_kinematics(m, data)
            published[hold, 0], published[hold, 1] = frames, centres
            if resets.tobytes() != _NONE:
                return hold
        return end

    def act(self, data: mujoco.MjData, control: Array) -> None:
        """Give the machine a control, as its env does at the start of a control interval."""
        data.ctrl[:] = control if self._map is None else self._map.control(control)

    def braking(self, data: mujoco.MjData) -> Array:
        """The control that brakes, shape (nu,)."""
        told = self._against_motion(data)
        return told if self._map is None else self._map.action(told)

    def brake(self, data: mujoco.MjData) -> None:
        """Give the machine the control that brakes."""
        data.ctrl[:] = self._against_motion(data)

    def settle(self, data: mujoco.MjData) -> bool:
        """Do what the env does to its data at the end of a control interval, and say whether it does anything."""
        return False

    def _against_motion(self, data: mujoco.MjData) -> Array:
        """Every actuator against its own motion, shape (nu,); read once per control interval, as controllers do."""
        rest, per_length, damping = self._servos
        told = rest + per_length * data.actuator_length - damping * data.actuator_velocity
        return np.asarray(np.minimum(np.maximum(told, self._low), self._high))

    def place(self, data: mujoco.MjData) -> None:
        """Take the places of mocap bodies, which positions do not determine, for later calls of `poses`."""
        if self._model.nmocap:
            self._still.mocap_pos[:], self._still.mocap_quat[:] = data.mocap_pos, data.mocap_quat

    def poses(self, qpos: Array) -> Poses:
        """Forward kinematics of positions of shape (k, nq)."""
        k, bodies = len(qpos), self._model.nbody
        frames, centres, axes = np.empty((k, bodies, 3)), np.empty((k, bodies, 3)), np.empty((k, bodies, 9))
        m, still = self._model, self._still
        places, seen = still.qpos, (still.xpos, still.xipos, still.xmat)
        for i, positions in enumerate(qpos):
            places[:] = positions
            mujoco.mj_kinematics(m, still)
            frames[i], centres[i], axes[i] = seen
        return Poses(frames, axes.reshape(k, bodies, 3, 3), centres)
