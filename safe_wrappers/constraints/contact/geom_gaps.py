"""Pairs of geoms of machine and world: their distances, and when they touch along a forecast."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.queries.geom_distance import geom_distance, nearest


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
        """Distance (m), the unit normal from the machine to the world, and the nearest points of both, shape (6,)."""
        return nearest(model, data, *self.pairs[pair])

    def touched(
        self, plant: MujocoPlant, forecast: Forecast, data: mujoco.MjData, pair: int
    ) -> Iterator[int]:
        """The instants of a forecast at which a contact of a pair has to be judged, in time.

        They are the first of every contact, the last of every control step in contact, and the first of every
        approach after a rebound in contact; in between the control is held, and the approach was judged when it
        began. Only the geoms' poses are written into `data`.
        """
        m, (a, b) = plant.model, self.pairs[pair]
        (centres, axes), (other, others) = _path(m, forecast, a), _path(m, forecast, b)
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
