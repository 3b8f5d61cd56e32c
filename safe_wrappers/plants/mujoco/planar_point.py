"""A point mass on two slides in a MuJoCo model: its joints, actuators and constants, and the walls around it."""

import copy
from collections.abc import Sequence
from typing import NamedTuple, NoReturn

import mujoco
import numpy as np

from safe_wrappers.control.backup.damped_axis import DampedAxis, damped_axis
from safe_wrappers.control.shapes import Rectangle, merged
from safe_wrappers.errors import Array, UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import refuse_mapped
from safe_wrappers.plants.mujoco.model import AT_A_JOINT, SLIDE
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_ALIGNED = 1e-6
_EXACT = 1e-9  # tolerance between the model's own step and the axes' constants, m and m/s
_TRIED = 12
_PLANE, _BOX = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_BOX)


class PlanarPoint(NamedTuple):
    """A point mass in a model; of pairs x is first, then y."""

    body: int  # index of the body
    axes: tuple[DampedAxis, DampedAxis]  # constants of the motion
    joints: list[int]  # indices of the two slides, in qpos and in qvel
    actuators: list[int]  # indices of their actuators
    origin: Array  # where the point is at qpos = 0, m, shape (2,)

    def motion(self, plant: MujocoPlant) -> tuple[Array, Array]:
        """Position, m, and velocity, m/s, in the plant's state, shapes (2,)."""
        return plant.qpos[self.joints] + self.origin, plant.qvel[self.joints]

    def control(self, like: Array, pair: Sequence[float] | Array) -> Array:
        """A control, shape (nu,), with other values on the two slides."""
        whole = np.array(like)
        whole[self.actuators] = pair
        return whole


def nearest_first(pairs: Array, asked: Array) -> Array:
    """Pairs, shape (k, 2), by their distance from the one that was asked for, shape (2,)."""
    return np.asarray(pairs[np.argsort(((pairs - asked) ** 2).sum(axis=1), kind="stable")])


def planar_point(plant: MujocoPlant, clip: float, body: str | None = None) -> PlanarPoint:
    """Find the point, measure its constants by single physics steps of the model, and check them.

    Springs, gravity, friction, coupling of the axes and other integrators are refused.

    Args:
        plant: Bound.
        clip: Speed per axis to which the env clips the motion at the start of each control step, m/s.
        body: Name of the body on the two slides; what else moves must not act on them. None: nothing else moves.

    Raises:
        UnsupportedEnvError: The model is not such a point; the message says why.
    """
    refuse_mapped(plant.action_map, "the closed form of a point's motion")
    m = plant.model
    slides = _slides(m, None if body is None else plant.named("body", body))
    data = mujoco.MjData(m)
    data.qpos[m.jnt_qposadr[list(slides)]] = 0.0
    mujoco.mj_kinematics(m, data)
    joints = _along_x_and_y(slides, data.xaxis)
    if m.jnt_limited[list(slides)].any():
        _refuse("its slides must have no limits (walls stop it, not joints)")
    actuators = _actuators(m, joints, alone=body is None)
    order = m.jnt_qposadr[list(joints)].tolist()
    axes = _measured(plant, order, actuators, clip)
    index = int(m.jnt_bodyid[slides[0]])
    return PlanarPoint(index, axes, order, actuators, data.xpos[index, :2].copy())


def _slides(m: mujoco.MjModel, body: int | None) -> tuple[int, int]:
    """Two slides of one body: of the only one that moves, or of the one with this index."""
    slides = [j for j in range(m.njnt) if m.jnt_type[j] == SLIDE and body in (None, m.jnt_bodyid[j])]
    if body is None and (len(slides), m.njnt, len(set(m.jnt_bodyid.tolist()))) != (2, 2, 1):
        kinds = [mujoco.mjtJoint(k).name[6:].lower() for k in m.jnt_type]
        _refuse(f"it needs one body on two slides and nothing else that moves; the model has {kinds}")
    # With free and ball joints only after them, one index serves positions and speeds.
    if len(slides) != 2 or any(m.jnt_qposadr[j] != m.jnt_dofadr[j] for j in slides):
        _refuse(
            f"the body {m.body(body).name!r} must have two slides of its own, before any free or ball joint of the "
            f"model; it has {len(slides)}"
        )
    return slides[0], slides[1]


def _along_x_and_y(slides: tuple[int, int], axes: Array) -> tuple[int, int]:
    """The slide along world x, then the one along world y."""
    for first, second in (slides, slides[::-1]):
        if np.allclose(axes[[first, second]], np.eye(3)[:2], atol=_ALIGNED):
            return first, second
    found = axes[list(slides)].round(3).tolist()
    _refuse(f"its slides must go along world x and world y; they go along {found}")


def _actuators(m: mujoco.MjModel, joints: tuple[int, int], alone: bool) -> list[int]:
    driven = [int(m.actuator_trnid[a, 0]) if m.actuator_trntype[a] in AT_A_JOINT else -1 for a in range(m.nu)]
    if alone and sorted(driven) != [0, 1]:
        _refuse("each of its slides needs a force actuator of its own, and there must be no other actuator")
    if [driven.count(j) for j in joints] != [1, 1]:
        _refuse("each of its slides needs a force actuator of its own, and only one")
    return [driven.index(joint) for joint in joints]


def _measured(
    plant: MujocoPlant, at: list[int], motors: list[int], clip: float
) -> tuple[DampedAxis, DampedAxis]:
    """The axes' constants from single physics steps of the plant's model without contacts."""
    m = plant.model
    least, most = plant.acting_range
    low, high = least[motors], most[motors]
    if not (np.isfinite([low, high]).all() and (low < 0.0).all() and (high > 0.0).all()):
        _refuse(f"its controls must be bounded and push both ways; they act from {least} to {most}")
    free = copy.copy(m)
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(free)

    def step(x: Array, v: Array, u: Array, around: np.random.Generator | None = None) -> tuple[Array, Array]:
        mujoco.mj_resetData(free, data)
        if around is not None:  # everything else that moves must make no difference
            data.qvel[:] = around.uniform(-1.0, 1.0, m.nv)
            mujoco.mj_integratePos(free, data.qpos, data.qvel, 1.0)
            data.ctrl[:] = np.clip(around.uniform(-1.0, 1.0, m.nu), least, most)
        data.qpos[at], data.qvel[at], data.ctrl[motors] = x, v, u
        mujoco.mj_step(free, data)
        return data.qpos[at].copy(), data.qvel[at].copy()

    zero = np.zeros(2)
    decay = step(zero, np.ones(2), zero)[1]
    gain = step(zero, zero, high)[1] / high
    h, rng = float(m.opt.timestep), np.random.default_rng(0)
    for _ in range(_TRIED):
        x, v, u = rng.uniform(-3.0, 3.0, 2), rng.uniform(-5.0, 5.0, 2), rng.uniform(low, high)
        x_next, v_next = step(x, v, u, rng)
        expected = decay * v + gain * u
        wrong = max(np.abs(v_next - expected).max(), np.abs(x_next - x - h * expected).max())
        if not (wrong <= _EXACT and (gain > 0.0).all() and (decay > 0.0).all() and (decay <= 1.0).all()):
            _refuse(
                "its slides must be plain damped masses, each pushed by its own motor with a gear above zero (no "
                f"springs, gravity or friction along them; Euler integrator); one step is {wrong:.2g} off that"
            )
    x_axis, y_axis = (
        damped_axis(float(decay[i]), float(gain[i]), h, plant.substeps, float(low[i]), float(high[i]), clip)
        for i in range(2)
    )
    return x_axis, y_axis


def _refuse(expectation: str) -> NoReturn:
    raise UnsupportedEnvError(
        f"this model is no point mass on two slides: {expectation}. Use Clearance for other machines."
    )


def walls(model: mujoco.MjModel, body: int) -> tuple[list[Rectangle], float]:
    """The walls, touching ones joined, m, and how far off the body's origin touches one (with contact margins), m.

    Walls are all that is fixed and that a body, given by its index, can touch as it slides along x and y without
    turning, except level floors.

    Raises:
        UnsupportedEnvError: No geom of the body collides with anything, or something it can touch moves or is not an
            upright box along x and y.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    welded = model.body_weldid[model.geom_bodyid]
    carried = model.body_mocapid[model.body_rootid[model.geom_bodyid]] >= 0
    types, affinities = model.geom_contype, model.geom_conaffinity
    own = np.flatnonzero((welded == body) & ((types > 0) | (affinities > 0)))
    if not own.size:
        raise UnsupportedEnvError(f"body {model.body(body).name!r} has no geom that collides with anything")
    offset = np.linalg.norm((data.geom_xpos[own] - data.xpos[body])[:, :2], axis=1)
    radius = float((offset + model.geom_rbound[own]).max())
    height, bound = data.geom_xpos[own, 2], model.geom_rbound[own]
    margin = float(model.geom_margin[own].max())
    bottom, top = float((height - bound).min()) - margin, float((height + bound).max()) + margin
    found: list[Rectangle] = []
    widest = 0.0
    for g in np.flatnonzero(welded != body):
        if not (types[g] & affinities[own] | types[own] & affinities[g]).any():
            continue
        name = model.geom(g).name or f"#{g}"
        turn, centre, size = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g], model.geom_size[g]
        kind = int(model.geom_type[g])
        if kind == _PLANE and abs(turn[2, 2]) >= 1.0 - _ALIGNED:
            continue
        if carried[g]:
            raise UnsupportedEnvError(
                f"geom {name!r} can be run into and moves; walls stand still. Use Clearance with obstacles that "
                "the env publishes (Discs)."
            )
        half = np.abs(turn) @ size if kind == _BOX else np.full(3, model.geom_rbound[g])
        gap = float(model.geom_margin[g])
        if kind != _PLANE and (centre[2] - half[2] - gap >= top or centre[2] + half[2] + gap <= bottom):
            continue
        aligned = np.allclose(np.sort(np.abs(turn), axis=1), [[0.0, 0.0, 1.0]] * 3, atol=_ALIGNED)
        if kind != _BOX or not aligned:
            what = mujoco.mjtGeom(kind).name[7:].lower()
            raise UnsupportedEnvError(
                f"geom {name!r} ({what}) can be run into and is not a box along x and y. Use Clearance with "
                "obstacles that describe it (Box, Disc, Plane)."
            )
        widest = max(widest, gap)
        (x, y, _), (dx, dy, _) = centre.tolist(), half.tolist()
        found.append((x - dx, x + dx, y - dy, y + dy))
    return merged(found), radius + margin + widest
