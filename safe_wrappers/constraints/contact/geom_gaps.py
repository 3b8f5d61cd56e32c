"""Pairs of geoms of machine and world: their distances, and when they touch along a forecast."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.numerics.compiled import compiled
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.constraint import Array
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.mujoco.native import mj_geomDistance
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_FAR = 1e6  # largest distance that is measured, m
# Offsets at which a distance is measured again, m.
_BESIDE = 1e-7 * np.array(
    [[0.0, 0.0, 0.0], [1.0, 0.3, 0.2], [-0.3, 1.0, -0.5], [0.4, -0.6, 1.0], [-1.0, -0.7, -0.4]]
)
_ROUND = int(mujoco.mjtGeom.mjGEOM_CAPSULE)  # up to it: planes, height fields, spheres, capsules
_NUDGE = 1e-6  # width of the differences that give a normal, m
_NORMAL = 1e-9  # distance below which the nearest points give no normal, m


class GeomGaps:
    """Pairs of geoms, one of the machine and one of the world.

    Args:
        machine: Names of bodies (all their geoms that can collide, or all if none can) or geoms.
        world: Likewise.

    Attributes:
        pairs: Ids of the geoms, (machine's, world's).
        touch: Distance from which MuJoCo lets each pair's contact act, shape (pairs,), m.
        moves: Whether joints move the world's geom, shape (pairs,).

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
        self.moves = np.array([tree[b] >= 0 for _, b in self.pairs])
        self._segment = np.zeros(6)

    def nearest(self, model: mujoco.MjModel, data: mujoco.MjData, pair: int) -> tuple[float, Array, Array]:
        """Distance (m), the unit normal from the machine to the world, and the nearest points of both, shape (6,)."""
        a, b = self.pairs[pair]
        gap = _distance(_measured(model, data, a, b), self._segment)
        between = self._segment[3:] - self._segment[:3]
        length = float(np.linalg.norm(between))
        points = self._segment.copy()
        if length < _NORMAL:
            return gap, self._steepest(model, data, a, b), points
        return gap, np.asarray(between * (np.sign(gap) / length)), points

    def _steepest(self, model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int) -> Array:
        """The direction in which moving the machine's geom shortens the distance most: a normal, by differences."""
        place, steepest = data.geom_xpos[a].copy(), np.zeros(3)
        pair, nearest = _measured(model, data, a, b), np.zeros(6)
        for axis, nudge in enumerate(_NUDGE * np.eye(3)):
            ends = []
            for moved in (place - nudge, place + nudge):
                data.geom_xpos[a] = moved
                ends.append(_distance(pair, nearest))
            steepest[axis] = ends[0] - ends[1]
        data.geom_xpos[a] = place
        return np.asarray(steepest / max(float(np.linalg.norm(steepest)), _NUDGE**2))

    def touched(
        self, plant: MujocoPlant, forecast: Forecast, data: mujoco.MjData, pair: int
    ) -> NDArray[np.int64]:
        """The instants of a forecast at which a contact of a pair has to be judged, in time.

        They are the first of every contact, the last of every control step in contact, and the first of every
        approach after a rebound in contact; in between the control is held, and the approach was judged when it
        began. Only the geoms' poses are written into `data`.
        """
        m, (a, b) = plant.model, self.pairs[pair]
        (centres, axes), (other, others) = _path(m, forecast, a), _path(m, forecast, b)
        steps = _farthest(m, a, centres, axes) + _farthest(m, b, other, others)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        paths = _Path(centres, axes, other, others, way)
        return _touched(_measured(m, data, a, b), paths, float(self.touch[pair]), plant.substeps)


class _Measured(NamedTuple):
    """Two geoms of a model whose distance is measured, and views of where they are in the data."""

    model: int
    data: int
    one: int
    other: int
    round: bool  # one of them is
    places: Array  # of all geoms
    turns: Array


class _Path(NamedTuple):
    """Centres (k, 3) and axes (k, 3, 3) of two geoms, and how far they have moved together at most, (k,), m."""

    centres: Array
    axes: Array
    other: Array
    others: Array
    way: Array


def _measured(model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int) -> _Measured:
    is_round = bool(model.geom_type[a] <= _ROUND or model.geom_type[b] <= _ROUND)
    return _Measured(model._address, data._address, a, b, is_round, data.geom_xpos, data.geom_xmat)


@compiled
def _touched(pair: _Measured, path: _Path, touch: float, substeps: int) -> NDArray[np.int64]:
    """As `GeomGaps.touched`."""
    k, instant, count = len(path.way), 0, 0
    found, segment = np.empty(k, np.int64), np.zeros(6)
    before, back = math.inf, False  # distance at the instant before, if in contact; whether it grew
    while instant < k:
        for i in range(3):
            pair.places[pair.one, i] = path.centres[instant, i]
            pair.places[pair.other, i] = path.other[instant, i]
            for j in range(3):
                pair.turns[pair.one, 3 * i + j] = path.axes[instant, i, j]
                pair.turns[pair.other, 3 * i + j] = path.others[instant, i, j]
        gap = _distance(pair, segment)
        if gap <= touch:
            ends = (instant + 1) % substeps == 0
            if before == math.inf or ends or (back and gap < before):
                found[count] = instant
                count += 1
            back, before = before < gap, gap
            instant += 1
        else:
            before, back = math.inf, False
            free, instant = path.way[instant] + gap - touch, instant + 1
            while instant < k and path.way[instant] < free:
                instant += 1
    return found[:count]


@compiled
def _geom_distance(pair: _Measured, segment: Array) -> float:
    return float(mj_geomDistance(pair.model, pair.data, pair.one, pair.other, _FAR, segment.ctypes.data))


@compiled
def _distance(pair: _Measured, segment: Array) -> float:
    """MuJoCo's distance of the geoms, m, and the nearest points into `segment`, shape (6,)."""
    # For about one in thirty pairs of boxes that are apart MuJoCo 3.11 returns 0, or the wrong sign: they are
    # measured again at small offsets, and the median of the results other than 0 counts. Round geoms do not need it.
    gap = _geom_distance(pair, segment)
    if gap > 0.0 or pair.round:
        return gap
    place = pair.places[pair.one]
    start, answers, chosen, count = place.copy(), np.empty(len(_BESIDE)), np.empty(len(_BESIDE), np.int64), 0
    for beside in range(len(_BESIDE)):
        place[:] = start + _BESIDE[beside]
        answers[beside] = _geom_distance(pair, segment)
        if answers[beside] != 0.0:
            at = count  # in order of the answers
            while at and answers[chosen[at - 1]] > answers[beside]:
                chosen[at] = chosen[at - 1]
                at -= 1
            chosen[at] = beside
            count += 1
    middle = chosen[count // 2] if count else len(_BESIDE) // 2
    place[:] = start + _BESIDE[middle]
    _geom_distance(pair, segment)
    place[:] = start
    return float(answers[middle])


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


def _path(model: mujoco.MjModel, forecast: Forecast, geom: int) -> tuple[Array, Array]:
    """Centres, shape (k, 3), and axes, shape (k, 3, 3), of a geom along a forecast."""
    poses, body = forecast.poses(), model.geom_bodyid[geom]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    axes = poses.axes[:, body]
    return poses.frames[:, body] + axes @ model.geom_pos[geom], axes @ turn.reshape(3, 3)


def _farthest(model: mujoco.MjModel, geom: int, centres: Array, axes: Array) -> Array:
    """How far any point of a geom has moved from instant to instant at most, shape (k - 1,), m."""
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    turned = np.linalg.norm(np.diff(axes, axis=0).reshape(-1, 9), axis=1)
    return np.asarray(moved + model.geom_rbound[geom] * turned)
