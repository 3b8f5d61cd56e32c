"""The contacts of a MuJoCo model, as they are and as forecast: which bodies, how far apart, how much force.

A `Replay` repeats an env's control step on separate data, and visits every evaluation of the physics.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import Array, name_list
from safe_wrappers.plants.mujoco.model import RESETS, fixed_bodies, named

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
    these alone are wrong by half of the impulse in the median step. Activations of actuators are not followed there.
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
    qpos, qvel, qacc = data.qpos, data.qvel, data.qacc
    qpos0, qvel0, velocity, acceleration = qpos.copy(), qvel.copy(), np.zeros(model.nv), np.zeros(model.nv)
    rate = np.zeros(model.nv)
    turns = _turns(model) if RATES_OF_ROTATION_VECTORS else np.zeros(0, dtype=np.intp)

    def move(at_rate: Array, at_acceleration: Array) -> None:
        qpos[:] = qpos0
        mujoco.mj_integratePos(model, qpos, at_rate, step_s)
        qvel[:] = qvel0 + step_s * at_acceleration

    for ahead, weight in _STAGES:
        mujoco.mj_forwardSkip(model, data, _FROM_POSITIONS, 1)
        visit(data, weight * step_s)
        stage = qvel
        if turns.size:
            stage = qvel.copy()
            stage[turns] = rotation_vector_rate(step_s * rate[turns], qvel[turns])
        velocity += weight * stage
        acceleration += weight * qacc
        if ahead:
            rate = ahead * stage
            move(rate, ahead * qacc)
            data.time = time + ahead * step_s
    move(velocity, acceleration)
    data.qacc_warmstart[:] = qacc


def _turns(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Degrees of freedom of the model's orientations (free and ball joints), shape (n, 3)."""
    orientations = model.jnt_type <= _BALL
    first = model.jnt_dofadr[orientations] + np.where(model.jnt_type[orientations] == _BALL, 0, 3)
    return np.asarray(first[:, None] + np.arange(3), dtype=np.intp)


def rotation_vector_rate(turned: Array, velocity: Array) -> Array:
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


# Bound of squared lengths: MuJoCo does not check the stages of the Runge-Kutta steps that are made here.
_FASTEST = float(mujoco.mjMAXVAL) ** 2


class Contacts(NamedTuple):
    """The n contacts of some evaluations of the physics. The fixed world is never the pushed body."""

    steps: int  # number of evaluations: of a held control one per physics substep, four with Runge-Kutta
    step: NDArray[np.intp]  # the evaluation that each contact belongs to, shape (n,)
    bodies: NDArray[np.intp]  # ids of the other body and of the pushed one, shape (n, 2); `nbody` is flexible
    gap: Array  # signed distance, shape (n,), m; negative where they penetrate
    point: Array  # shape (n, 3), m
    normal: Array  # pointing at the pushed body, shape (n, 3)
    friction: Array  # of sliding, shape (n,): the smaller of two directions'; 0 without friction (condim 1)
    force: Array  # on the pushed body, shape (n, 3), N
    finite: bool  # False where MuJoCo resets the state: contacts are meaningless
    holds: int = 1  # control intervals

    @property
    def body(self) -> NDArray[np.intp]:
        """Ids of the pushed bodies, shape (n,)."""
        return self.bodies[:, 1]


_WHOLE, _REAL = np.zeros((0, 2), dtype=np.intp), np.zeros((0, 9))
_NOTHING = (
    *(_WHOLE[:, 0], _WHOLE, _WHOLE[:, 0], _WHOLE[:, 0]),
    *(_REAL[:, 0], _REAL[:, :3], _REAL, _REAL[:, :5], _REAL[:, :6]),
)
"""What `ContactReader.read` keeps of an evaluation without contacts."""


class ContactReader:
    """Reads those contacts of a model that its solver has, evaluation by evaluation.

    Args:
        model: Of the data to be read.
        watched: Which two bodies count, shape (nbody + 1, nbody + 1); the last stands for flexible parts. None: all.
    """

    def __init__(self, model: mujoco.MjModel, watched: NDArray[np.bool_] | None = None) -> None:
        self._model = model
        self._watched = np.ones((model.nbody + 1,) * 2, dtype=bool) if watched is None else watched
        self._fixed = np.append(fixed_bodies(model), False)
        self._body_of_geom = np.append(model.geom_bodyid, model.nbody)  # the last is for geom -1
        self.clear()

    def clear(self) -> None:
        """Forget what has been read."""
        self._steps = 0
        self._seen = [_NOTHING]

    def read(self, data: mujoco.MjData) -> None:
        """Copy the contacts, as MuJoCo has computed them last; `found` chooses among them."""
        step, contact = self._steps, data.contact
        self._steps += 1
        if not data.ncon:
            return
        wrenches = np.empty((data.ncon, 6))
        for i, wrench in enumerate(wrenches):
            mujoco.mj_contactForce(self._model, data, i, wrench)
        kinds = contact.geom, contact.efc_address, contact.dim
        places = contact.dist, contact.pos, contact.frame, contact.friction
        copies = (part.copy() for part in (*kinds, *places))
        self._seen.append((np.full(data.ncon, step), *copies, wrenches))

    def found(self, finite: bool = True) -> Contacts:
        """The watched contacts that have been read since `clear`."""
        step, geoms, row, dim, gap, point, frame, friction, wrench = map(
            np.concatenate, zip(*self._seen, strict=True)
        )
        bodies = self._body_of_geom[geoms]
        chosen = self._watched[bodies[:, 0], bodies[:, 1]] & (row >= 0)
        # MuJoCo's normal points from the first geom to the second, and its force pushes the second.
        turned = self._fixed[bodies[:, 1]][:, None]
        side, bodies = np.where(turned, -1.0, 1.0), np.where(turned, bodies[:, ::-1], bodies)
        frame = frame.reshape(-1, 3, 3)
        force = side * np.einsum("ki,kij->kj", wrench[:, :3], frame)
        sliding = friction[:, :2].min(axis=1) * (dim > 1)
        return Contacts(
            *(self._steps, step[chosen], bodies[chosen], gap[chosen], point[chosen]),
            *((side * frame[:, 0])[chosen], sliding[chosen], force[chosen], finite),
        )

    def follow(self, data: mujoco.MjData, substeps: int) -> Contacts:
        """Step the data, with the control it has, and return the contacts of all these physics substeps."""
        data.warning.number[RESETS] = 0
        self.clear()
        inside = True

        def visit(at: mujoco.MjData, _: float) -> None:
            nonlocal inside
            self.read(at)
            inside = inside and bool(at.qacc @ at.qacc < _FASTEST)

        for _ in range(substeps):
            evaluations(self._model, data, visit)
        inside = inside and bool(data.qvel @ data.qvel < _FASTEST and data.qpos @ data.qpos < _FASTEST)
        return self.found(inside and not data.warning.number[RESETS].any())


def between(
    model: mujoco.MjModel, bodies: Sequence[str] | None = None, against: Sequence[str] | None = None
) -> NDArray[np.bool_]:
    """For a `ContactReader`: the contacts between named bodies and those they touch; None is all of them.

    Raises:
        UnknownNameError: No body has that name; the message lists all names.
    """
    one, other = chosen_bodies(model, "bodies", bodies), chosen_bodies(model, "against", against)
    return np.asarray(one[:, None] & other | other[:, None] & one)


def on_the_world(model: mujoco.MjModel, robot: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """For a `ContactReader`: the contacts of moving bodies, of a robot's, shape (nbody,), with the fixed world."""
    fixed = fixed_bodies(model)
    ours, world = np.append(~fixed if robot is None else robot & ~fixed, False), np.append(fixed, False)
    return np.asarray(ours[:, None] & world | world[:, None] & ours)


def can_touch_the_world(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which moving bodies have a geom that may meet one of the fixed world's with friction, shape (nbody,)."""
    fixed = fixed_bodies(model)[model.geom_bodyid]
    kind, other, size = model.geom_contype, model.geom_conaffinity, model.geom_condim
    found = np.zeros(model.nbody, dtype=bool)
    for ground in np.flatnonzero(fixed):
        meets = (kind & other[ground]) | (kind[ground] & other)
        found[model.geom_bodyid[~fixed & (meets != 0) & (np.maximum(size, size[ground]) > 1)]] = True
    for one, two, dim in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True):
        if dim > 1 and fixed[one] != fixed[two]:
            found[model.geom_bodyid[two if fixed[one] else one]] = True
    return found


def chosen_bodies(model: mujoco.MjModel, argument: str, names: Sequence[str] | None) -> NDArray[np.bool_]:
    """Which bodies are named, shape (nbody + 1,); the last entry stands for flexible parts, which have no name."""
    chosen = np.full(model.nbody + 1, names is None)
    if names is not None:
        names = name_list(argument, names, "names of bodies", "None for all")
        chosen[[named(model, "body", name, argument) for name in names]] = True
    return chosen
