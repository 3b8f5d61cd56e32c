"""Replay: repeat an env's control step on separate data, and visit every evaluation of the physics."""

from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

Visit = Callable[[mujoco.MjData, float], None]
"""Takes data with the contacts and forces of one evaluation, and the time for which it counts, s."""

_INPUTS: Final = mujoco.mjtState.mjSTATE_USER
_PHYSICS: Final = mujoco.mjtState.mjSTATE_PHYSICS
RK4: Final = int(mujoco.mjtIntegrator.mjINT_RK4)
_FROM_POSITIONS: Final = int(mujoco.mjtStage.mjSTAGE_NONE)
_STAGES: Final = ((0.5, 1.0 / 6.0), (0.5, 1.0 / 3.0), (1.0, 1.0 / 3.0), (0.0, 1.0 / 6.0))
"""Where the next evaluation is, in time steps, and the weight of this one."""
RATES_OF_ROTATION_VECTORS: Final = mujoco.mj_version() >= 4_000_000
"""From MuJoCo 4.0 on Runge-Kutta averages rates of the rotation vector since the step's start; before, the stages'
angular velocities."""
_BALL: Final = int(mujoco.mjtJoint.mjJNT_BALL)
_ROUNDING: Final = 1e-10  # of Runge-Kutta steps against MuJoCo's: a compiler may fuse a product and a sum


class Replay:
    """Repeats the step of an unwrapped env with MuJoCo `.model` and `.data`, which are only read.

    The inputs (controls, applied forces, mocap poses) are taken as they are after the env's step. An env that changes
    them between substeps, or writes to the state, ends elsewhere than the replay; then `after` returns False.

    Runge-Kutta steps are made here stage by stage, since MuJoCo keeps only the forces of the last stage; on Ant-v5
    these alone are wrong by half of the impulse in the median step.
    """

    def __init__(self, raw: Any) -> None:
        self._raw = raw
        self._model: Any = None

    def before(self) -> None:
        """Copy all data before the env's step: MuJoCo's state alone does not say which bodies sleep."""
        if self._model is not self._raw.model:  # the first time, or the env has a new model
            self._model = self._raw.model
            self._data = mujoco.MjData(self._model)
            self._inputs = np.zeros(mujoco.mj_stateSize(self._model, int(_INPUTS)))
            self._end, self._there = np.zeros((2, mujoco.mj_stateSize(self._model, int(_PHYSICS))))
        mujoco.mj_copyData(self._data, self._model, self._raw.data)

    def after(self, visit: Visit) -> bool:
        """Replay the step that the env has made since, and call `visit` at each evaluation; once per step.

        Returns whether it ends in the env's own state, bit for bit (Runge-Kutta: up to rounding). If not, what was
        visited is not what happened in the env.
        """
        model: mujoco.MjModel = self._raw.model
        data, there = self._data, self._raw.data
        if model is not self._model:
            return False
        mujoco.mj_getState(model, there, self._inputs, int(_INPUTS))
        mujoco.mj_setState(model, data, self._inputs, int(_INPUTS))
        step_s = float(model.opt.timestep)
        for _ in range(round((there.time - data.time) / step_s)):
            evaluations(model, data, visit)
        mujoco.mj_getState(model, data, self._end, int(_PHYSICS))
        mujoco.mj_getState(model, there, self._there, int(_PHYSICS))
        if model.opt.integrator == RK4:
            return bool(np.allclose(self._end, self._there, rtol=_ROUNDING, atol=_ROUNDING))
        return np.array_equal(self._end, self._there)


def evaluations(model: mujoco.MjModel, data: mujoco.MjData, visit: Visit) -> None:
    """Make one physics substep and visit its evaluations of the physics; Runge-Kutta has four."""
    if model.opt.integrator == RK4:
        _runge_kutta(model, data, visit)
        return
    mujoco.mj_step(model, data)  # it leaves the forces that it has integrated in the data
    visit(data, float(model.opt.timestep))


def _runge_kutta(model: mujoco.MjModel, data: mujoco.MjData, visit: Visit) -> None:
    """`mj_step` by the classical four stages, in the order of MuJoCo's own sums."""
    step_s, time = float(model.opt.timestep), data.time
    qpos, qvel, act, qacc, act_dot = data.qpos, data.qvel, data.act, data.qacc, data.act_dot
    qpos0, qvel0, act0 = qpos.copy(), qvel.copy(), act.copy()
    velocity, acceleration, activation = np.zeros(model.nv), np.zeros(model.nv), np.zeros(model.na)
    rate = np.zeros(model.nv)
    turns = _turns(model) if RATES_OF_ROTATION_VECTORS else np.zeros(0, dtype=np.intp)
    for ahead, weight in _STAGES:
        mujoco.mj_forwardSkip(model, data, _FROM_POSITIONS, 1)
        visit(data, weight * step_s)
        stage = qvel
        if turns.size:
            stage = qvel.copy()
            stage[turns] = rotation_vector_rate(step_s * rate[turns], qvel[turns])
        velocity += weight * stage
        acceleration += weight * qacc
        if model.na:
            activation += weight * act_dot
        if ahead:
            rate = ahead * stage
            qpos[:] = qpos0
            mujoco.mj_integratePos(model, qpos, rate, step_s)
            qvel[:] = qvel0 + step_s * (ahead * qacc)
            if model.na:
                act[:] = act0 + step_s * (ahead * act_dot)
            data.time = time + ahead * step_s
    qpos[:] = qpos0
    mujoco.mj_integratePos(model, qpos, velocity, step_s)
    qvel[:] = qvel0 + step_s * acceleration
    if model.na:
        act[:] = _within_ranges(model, act0 + step_s * activation)
    data.qacc_warmstart[:] = qacc


def _turns(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Degrees of freedom of the model's orientations (free and ball joints), shape (n, 3)."""
    orientations = model.jnt_type <= _BALL
    first = model.jnt_dofadr[orientations] + np.where(model.jnt_type[orientations] == _BALL, 0, 3)
    return np.asarray(first[:, None] + np.arange(3), dtype=np.intp)


def rotation_vector_rate(turned: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rates of rotation vectors, rad/s, from angular velocities in the turned body's frame, rad/s; shapes (n, 3).

    The inverse of the exponential's derivative: Iserles et al., "Lie-group methods", Acta Numerica 9 (2000).
    """
    with np.errstate(over="ignore", invalid="ignore"):  # `visit` judges such numbers
        half = 0.5 * np.linalg.norm(turned, axis=1, keepdims=True)
        small = half < 1e-6
        angle = np.where(small, 1.0, half)
        second = np.where(small, 1.0 / 12.0, (1.0 - angle / np.tan(angle)) / (4.0 * angle**2))
        across = np.cross(turned, velocity)
        return np.asarray(velocity + 0.5 * across + second * np.cross(turned, across))


def _within_ranges(model: mujoco.MjModel, act: np.ndarray) -> np.ndarray:
    """Activations clipped where their actuators limit them."""
    limited = model.actuator_actlimited.astype(bool) & (model.actuator_actadr >= 0)
    last = model.actuator_actadr[limited] + model.actuator_actnum[limited] - 1
    act[last] = np.clip(act[last], *model.actuator_actrange[limited].T)
    return act
