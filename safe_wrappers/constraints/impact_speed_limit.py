"""ImpactSpeedLimit: bound the peak force of contacts by the approach speed."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import mujoco
import numpy as np

from safe_wrappers.constraints.rollout import RolloutConstraint
from safe_wrappers.control.contact import peak_force
from safe_wrappers.errors import Array, ConfigurationError, UnknownNameError, name_list, positive
from safe_wrappers.plants.mujoco.forecast import MujocoTrajectory
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

_FAR = 1e6  # largest distance that is measured, m
# Offsets at which a distance is measured again, m.
_BESIDE = 1e-7 * np.array(
    [[0.0, 0.0, 0.0], [1.0, 0.3, 0.2], [-0.3, 1.0, -0.5], [0.4, -0.6, 1.0], [-1.0, -0.7, -0.4]]
)
_ROUND = int(mujoco.mjtGeom.mjGEOM_CAPSULE)  # up to it: planes, height fields, spheres, capsules
_NUDGE = 1e-6  # width of the differences that give a normal, m
_NORMAL = 1e-9  # distance below which the nearest points give no normal, m
_FIXED = 1e-12  # mobility along the normal, 1/kg, below which a geom cannot move into contact


class Contact(NamedTuple):
    """A contact, now or at the present speed."""

    gap: float  # m, negative inside
    peak: float  # force by the deepest deflection, under a push that goes on, N


@dataclass
class ImpactSpeedLimit(RolloutConstraint):
    """Keep the approach speed at every contact so low that its peak force stays below a limit.

    Effective mass, push and speed at every contact come from a forecast of the held control, and then of the actuated
    joints braking.

    Best effort: along the held step of an executed control that is not flagged every first touch keeps the limit, for
    a plant that is right, a contact that is a linear spring of the declared stiffness, and one pair of geoms at a
    time. Not counted are friction, other contacts, joint stops, and the way of obstacles that the env
    moves (mocap) during the forecast. The
    physics step should be at most a tenth of `control.contact.time_to_peak`.

    Args:
        bodies: Names of the machine's bodies (all their geoms that can collide, or all if none can) or geoms.
        against: Names of bodies or geoms of the world; the speed of free ones counts.
        force_limit: Largest peak force, N, of each pair of geoms.
        stiffness: Of the interface, N/m: of both sides in series.
        margin: Kept free below the limit, N.
        horizon: Control steps to forecast; cover the time of braking and of a contact.
    """

    bodies: Sequence[str]
    against: Sequence[str]
    force_limit: float
    stiffness: float
    margin: float = 0.0
    horizon: int = 5

    max_decrease: float | None = field(default=None, init=False, repr=False)
    unit: ClassVar[str] = "N"

    def __post_init__(self) -> None:
        self._check_shared()
        for name in ("bodies", "against"):
            setattr(self, name, name_list(name, getattr(self, name), "names of bodies or geoms"))
        self.force_limit = positive("force_limit", self.force_limit, "N")
        self.stiffness = positive("stiffness", self.stiffness, "N/m")
        if self.margin >= self.force_limit:
            nothing = f"the margin {self.margin} N leaves nothing"
            raise ConfigurationError(f"{nothing} of the limit {self.force_limit} N")

    def setup(self, plant: Plant) -> None:
        plant.require_acceleration("ImpactSpeedLimit")
        super().setup(plant)
        m = self.plant.model
        self._gaps = GeomGaps(self.plant, self.bodies, self.against)
        self._probe = mujoco.MjData(m)
        self.scale = self.force_limit

    def place(self, qpos: Array, qvel: Array, control: Array | None) -> None:
        """Everything about a state but its constraint forces; without a control the actuators do not push."""
        m, d = self.plant.model, self._probe
        d.qpos[:] = qpos
        self._pushing = control is not None
        if control is not None:
            d.ctrl[:] = self.plant.controls(control)
        mujoco.mj_fwdPosition(m, d)
        # Once the motion has stopped, damping no longer holds back.
        d.qvel[:] = 0.0
        self._resting = self._forces()
        self._speeds = d.qvel[:] = qvel
        self._moving = self._forces()

    def _forces(self) -> Array:
        """Generalised forces without those of constraints, shape (nv,)."""
        m, d = self.plant.model, self._probe
        mujoco.mj_fwdVelocity(m, d)
        mujoco.mj_fwdActuation(m, d)
        mujoco.mj_fwdAcceleration(m, d)
        return np.asarray(d.qfrc_smooth - (0.0 if self._pushing else d.qfrc_actuator))

    def contact(self, pair: int) -> Contact:
        """What a contact of the pair would be like, at the state of `place`."""
        m, d = self.plant.model, self._probe
        gap, normal, points = self._gaps.nearest(self.plant.model, d, pair)
        robot, other = self._gaps.pairs[pair]
        closing, turning, other_jacobian = np.zeros((3, 3, m.nv))
        for of, found in ((mujoco.mj_jac, closing), (mujoco.mj_jacDot, turning)):
            of(m, d, found, None, points[:3], m.geom_bodyid[robot])
            of(m, d, other_jacobian, None, points[3:], m.geom_bodyid[other])
            found -= other_jacobian
        row, given = normal @ closing, np.zeros((1, m.nv))
        mujoco.mj_solveM(m, d, given, row[None])
        mobility = float(row @ given[0])
        if mobility < _FIXED:
            return Contact(gap, 0.0)  # no motion makes it deeper or less deep
        mass, speed = 1.0 / mobility, float(row @ self._speeds)
        moving = float(given[0] @ self._moving + normal @ turning @ self._speeds)
        push = mass * max(moving, float(given[0] @ self._resting), 0.0)
        return Contact(gap, float(peak_force(speed, mass, self.stiffness, push, max(-gap, 0.0))))

    def proposals(self, control: Array | None) -> Iterable[Array]:
        """The braking with which every trajectory goes on: what was admitted for its sake stays admissible."""
        return () if control is not None else (self.plant.braking(),)

    def h_along(self, path: MujocoTrajectory) -> Array:
        """What every pair's contact leaves of the limit; without one all of it, N."""
        if path.control is None:
            return self._now()
        k, pairs = len(path.qpos), len(self._gaps.pairs)
        if not np.isfinite(path.qpos[-1]).all():
            return np.full((k, pairs), np.nan)  # MuJoCo's simulation has diverged
        soon, left = self.plant.substeps - 1, np.full((k, pairs), self.force_limit)
        for pair in range(pairs):
            for instant in list(self._gaps.touched(self.plant, path, self._probe, pair)):
                # At the end of the held step another control takes over.
                control = path.control if instant < soon or instant == 0 else None
                self.place(path.qpos[instant], path.qvel[instant], control)
                left[instant, pair] -= self.contact(pair).peak
        return left

    def _now(self) -> Array:
        m, d, what = self.plant.model, self._probe, int(mujoco.mjtState.mjSTATE_INTEGRATION)
        state = np.zeros(mujoco.mj_stateSize(m, what))
        mujoco.mj_getState(m, self.plant.pose(), state, what)
        mujoco.mj_setState(m, d, state, what)
        self.place(self.plant.qpos, self.plant.qvel, None)
        contacts = [self.contact(pair) for pair in range(len(self._gaps.pairs))]
        left = self.force_limit - np.array([contact.peak for contact in contacts])
        # Only a contact that is there counts; before it, how it will be is the forecast's to say.
        there = np.array([contact.gap for contact in contacts]) <= self._gaps.touch
        return np.where(there, left, np.maximum(left, 0.0))[None]


class GeomGaps:
    """Pairs of geoms, one of the machine and one of the world.

    Args:
        machine: Names of bodies (all their geoms that can collide, or all if none can) or geoms.
        world: Likewise.

    Attributes:
        pairs: Ids of the geoms, (machine's, world's).
        touch: Distance from which MuJoCo lets each pair's contact act, shape (pairs,), m.

    Raises:
        UnknownNameError: Neither a body nor a geom has such a name.
        ConfigurationError: A body without geoms, or one that belongs to the machine itself declared as the world's.
    """

    def __init__(self, plant: MujocoPlant, machine: Sequence[str], world: Sequence[str]) -> None:
        m = plant.model
        own = [geom for name in machine for geom in _geoms(plant, name)]
        tree = m.body_treeid[m.geom_bodyid]
        for name in machine:
            if (tree[_geoms(plant, name)] < 0).any():
                raise ConfigurationError(f"no joint moves {name!r}: it cannot run into anything")
        others: list[int] = []
        for name in world:
            found = _geoms(plant, name)
            if np.isin(tree[found], tree[own]).any():
                raise ConfigurationError(
                    f"{name!r} is part of the machine itself, on the same joints as {', '.join(machine)}: it "
                    "cannot be an obstacle to it"
                )
            others += found
        self.pairs = [(a, b) for a in dict.fromkeys(own) for b in dict.fromkeys(others)]
        self.touch = np.array([max(m.geom_margin[a], m.geom_margin[b], 0.0) for a, b in self.pairs])

    def nearest(self, model: mujoco.MjModel, data: mujoco.MjData, pair: int) -> tuple[float, Array, Array]:
        """Distance (m), the unit normal from the machine to the world, and the nearest points of both, shape (6,).

        `data` has the geoms' poses; they are the same afterwards.
        """
        points, (first, second) = np.zeros(6), self.pairs[pair]
        gap = geom_distance(model, data, first, second, points)
        between = points[3:] - points[:3]
        length = float(np.linalg.norm(between))
        if length < _NORMAL:
            return gap, _steepest(model, data, first, second), points
        return gap, np.asarray(between * (np.sign(gap) / length)), points

    def touched(
        self, plant: MujocoPlant, path: MujocoTrajectory, data: mujoco.MjData, pair: int
    ) -> Iterator[int]:
        """The instants of a trajectory at which a contact of a pair has to be judged, in time.

        They are the first of every contact, the last of every control step in contact, and the first of every
        approach after a rebound in contact; in between the control is held, and the approach was judged when it
        began. Only the geoms' poses are written into `data`.
        """
        m, (a, b) = plant.model, self.pairs[pair]
        (centres, axes), (other, others) = _path(m, path, a), _path(m, path, b)
        steps = _farthest(m, a, centres, axes) + _farthest(m, b, other, others)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        k, touch, instant = len(centres), self.touch[pair], 0
        before, back = np.inf, False  # distance at the instant before, if in contact; whether it grew
        while instant < k:
            data.geom_xpos[a], data.geom_xmat[a] = centres[instant], axes[instant].ravel()
            data.geom_xpos[b], data.geom_xmat[b] = other[instant], others[instant].ravel()
            gap = geom_distance(m, data, a, b)
            if gap <= touch:
                ends = (instant + 1) % plant.substeps == 0
                if before == np.inf or ends or (back and gap < before):
                    yield instant
                before, back = gap, before < gap
                instant += 1
            else:
                before, back = np.inf, False
                instant = max(instant + 1, int(np.searchsorted(way, way[instant] + gap - touch)))


def _geoms(plant: MujocoPlant, name: str) -> list[int]:
    m = plant.model
    bodies, geoms = plant.names("body"), plant.names("geom")
    if name in bodies:
        body = plant.named("body", name)
        every = [g for g in range(m.ngeom) if m.geom_bodyid[g] == body]
        if not every:
            raise ConfigurationError(f"body {name!r} has no geoms; name bodies or geoms with a shape")
        return [g for g in every if m.geom_contype[g] or m.geom_conaffinity[g]] or every
    if name in geoms:
        return [plant.named("geom", name)]
    there = f"bodies: {', '.join(bodies)}; geoms: {', '.join(geoms)}"
    raise UnknownNameError(f"the model has no body or geom {name!r}; {there}")


def _path(model: mujoco.MjModel, path: MujocoTrajectory, geom: int) -> tuple[Array, Array]:
    """Centres, shape (k, 3), and axes, shape (k, 3, 3), of a geom along a trajectory."""
    poses, body = path.poses(), model.geom_bodyid[geom]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    axes = poses.axes[:, body]
    return poses.frames[:, body] + axes @ model.geom_pos[geom], axes @ turn.reshape(3, 3)


def _farthest(model: mujoco.MjModel, geom: int, centres: Array, axes: Array) -> Array:
    """How far any point of a geom has moved from instant to instant at most, shape (k - 1,), m."""
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    turned = np.linalg.norm(np.diff(axes, axis=0).reshape(-1, 9), axis=1)
    return np.asarray(moved + model.geom_rbound[geom] * turned)


def _steepest(model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int) -> Array:
    """The direction in which moving the first geom shortens the distance most: a normal, by differences."""
    place, steepest = data.geom_xpos[a].copy(), np.zeros(3)
    for axis, nudge in enumerate(_NUDGE * np.eye(3)):
        ends = []
        for moved in (place - nudge, place + nudge):
            data.geom_xpos[a] = moved
            ends.append(geom_distance(model, data, a, b))
        steepest[axis] = ends[0] - ends[1]
    data.geom_xpos[a] = place
    return np.asarray(steepest / max(float(np.linalg.norm(steepest)), _NUDGE**2))


def geom_distance(
    model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int, segment: Array | None = None
) -> float:
    """MuJoCo's distance of two geoms, m, and the nearest points into `segment`."""
    # For about one in thirty pairs of boxes that are apart MuJoCo 3.11 returns 0, or the wrong sign: they are
    # measured again at small offsets, and the median of the results other than 0 counts. Round geoms do not need it.
    gap = mujoco.mj_geomDistance(model, data, a, b, _FAR, segment)
    if gap > 0.0 or model.geom_type[a] <= _ROUND or model.geom_type[b] <= _ROUND:
        return float(gap)
    place, answers = data.geom_xpos[a].copy(), []
    for beside in _BESIDE:
        data.geom_xpos[a] = place + beside
        answers.append((float(mujoco.mj_geomDistance(model, data, a, b, _FAR, None)), beside))
    there = sorted((a for a in answers if a[0] != 0.0), key=lambda a: a[0]) or answers
    gap, beside = there[len(there) // 2]
    if segment is not None:
        data.geom_xpos[a] = place + beside
        mujoco.mj_geomDistance(model, data, a, b, _FAR, segment)
    data.geom_xpos[a] = place
    return gap
