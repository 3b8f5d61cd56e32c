"""The next impact: which two geoms of a MuJoCo model will touch first, as they move now."""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.queries.geom_distance import nearest

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_UNMEASURED = {int(mujoco.mjtGeom.mjGEOM_HFIELD): "height field", int(mujoco.mjtGeom.mjGEOM_SDF): "SDF"}
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Impact(NamedTuple):
    """An impact to come; without one the time is inf, and of a state that is not finite all is NaN."""

    bodies: tuple[int, int] | None = None  # ids, the smaller first
    time_s: float = math.inf  # until the contact acts, at the present speeds
    speed: float = math.nan  # of the approach along the normal of the nearest points, m/s, > 0
    mass: float = math.nan  # effective, of both along that normal, kg


class NextImpact:
    """Finds the pair of geoms that will touch first at the present speeds, of those that do not touch already.

    A pair counts if MuJoCo lets it collide, its bodies are watched, and its nearest points approach each other; that
    it turns, speeds up or stops on the way does not. Bounding spheres say which pairs cannot be the first, so that
    few distances are measured.

    Args:
        model: With geoms of any kind but height fields and signed distance functions among those that count.
        watched: Which two bodies are watched, shape (nbody + 1, nbody + 1); the last is what is flexible.

    Raises:
        UnsupportedEnvError: Something watched whose distances MuJoCo does not measure.
    """

    def __init__(self, model: mujoco.MjModel, watched: NDArray[np.bool_]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._state = np.zeros(mujoco.mj_stateSize(model, _STATE))
        self._first, self._second, self._touch = _colliding(model, watched)
        if model.nflex and watched[:, -1].any():
            raise UnsupportedEnvError("impacts of flexible parts cannot be predicted: watch other bodies")
        for kind, name in _UNMEASURED.items():
            for geom in np.flatnonzero(model.geom_type == kind):
                if geom in self._first or geom in self._second:
                    body = model.body(model.geom_bodyid[geom]).name
                    raise UnsupportedEnvError(f"the impacts of a {name} (of {body!r}) cannot be predicted")
        self._pairs = list(zip(self._first.tolist(), self._second.tolist(), strict=True))
        self._touches: list[float] = self._touch.tolist()
        self._plane = model.geom_type[self._second] == _PLANE
        self._radius = model.geom_rbound.copy()
        self._jacobians = np.zeros((2, 3, model.nv))
        self._mobile = np.zeros((1, model.nv))

    def of(self, data: mujoco.MjData) -> Impact:
        """The next impact of a state, which is only read."""
        m, d = self._model, self._data
        mujoco.mj_getState(m, data, self._state, _STATE)
        if not np.isfinite(self._state).all():
            return Impact(time_s=math.nan)
        if not self._first.size:
            return Impact()
        mujoco.mj_setState(m, d, self._state, _STATE)
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_comVel(m, d)
        turning, moving = _velocities(m, d)
        soonest, found = math.inf, None
        for pair, least_s in self._in_order(turning, moving):
            if least_s >= soonest:
                break
            a, b = self._pairs[pair]
            gap, normal, points = nearest(m, d, a, b)
            left = gap - self._touches[pair]
            if left <= 0.0:
                continue
            way = normal.tolist()
            ends = (points[:3] - d.geom_xpos[a]).tolist(), (points[3:] - d.geom_xpos[b]).tolist()
            speed = _along(way, turning[a].tolist(), ends[0]) - _along(way, turning[b].tolist(), ends[1])
            speed += float(normal @ (moving[a] - moving[b]))
            if speed > 0.0 and left / speed < soonest:
                soonest, found = left / speed, (a, b, normal, points, speed)
        if found is None:
            return Impact()
        a, b, normal, points, speed = found
        one, other = int(m.geom_bodyid[a]), int(m.geom_bodyid[b])
        return Impact(
            (min(one, other), max(one, other)), soonest, speed, self._mass(one, other, normal, points)
        )

    def _in_order(self, turning: Array, moving: Array) -> list[tuple[int, float]]:
        """Pairs by a lower bound on their time, s: bounding spheres, and no point faster than its sphere allows."""
        a, b, d = self._first, self._second, self._data
        between = d.geom_xpos[b] - d.geom_xpos[a]
        normals = d.geom_xmat[b][:, 2::3]
        apart = np.where(
            self._plane, -np.einsum("ki,ki->k", between, normals), np.sqrt((between**2).sum(axis=1))
        )
        left = np.maximum(apart - self._radius[a] - self._radius[b] - self._touch, 0.0)
        spin = self._radius * np.sqrt((turning**2).sum(axis=1))
        fastest = np.sqrt(((moving[a] - moving[b]) ** 2).sum(axis=1)) + spin[a] + spin[b]
        least_s = np.where(fastest > 0.0, left / np.where(fastest > 0.0, fastest, 1.0), np.inf)
        order = np.argsort(least_s, kind="stable")
        return list(zip(order.tolist(), least_s[order].tolist(), strict=True))

    def _mass(self, one: int, other: int, normal: Array, points: Array) -> float:
        m, d, (first, second) = self._model, self._data, self._jacobians
        mujoco.mj_jac(m, d, first, None, points[:3], one)
        mujoco.mj_jac(m, d, second, None, points[3:], other)
        row = normal @ (first - second)
        mujoco.mj_solveM(m, d, self._mobile, row[None])
        return 1.0 / float(row @ self._mobile[0])  # what approaches is moved by some joint


def _colliding(
    model: mujoco.MjModel, watched: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """The watched pairs that MuJoCo lets collide, a plane as the second; the distance from which each acts, m."""
    body, weld = model.geom_bodyid, model.body_weldid
    # By `mj_collision`'s rules: not welded together, no parent and child (but the world), not excluded.
    above = weld[model.body_parentid[weld]]
    filters = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    excluded = {tuple(sorted(divmod(int(sign), 1 << 16))) for sign in model.exclude_signature}
    found: dict[tuple[int, int], float] = {}
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
    for i, j in zip(*np.triu_indices(model.ngeom, 1), strict=True):
        one, other = weld[body[i]], weld[body[j]]
        related = filters and one and other and (one == above[other] or other == above[one])
        meets = model.geom_contype[i] & model.geom_conaffinity[j] or (
            model.geom_contype[j] & model.geom_conaffinity[i]
        )
        apart = tuple(sorted((int(body[i]), int(body[j])))) in excluded
        if one != other and meets and not related and not apart:
            found[int(i), int(j)] = max(model.geom_margin[i], model.geom_margin[j])
    for i, j, margin in zip(model.pair_geom1, model.pair_geom2, model.pair_margin, strict=True):
        found[min(int(i), int(j)), max(int(i), int(j))] = margin
    pairs = [(pair, touch) for pair, touch in found.items() if watched[body[pair[0]], body[pair[1]]]]
    ends = [(j, i) if model.geom_type[i] == _PLANE else (i, j) for (i, j), _ in pairs]
    first, second = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    return first, second, np.array([touch for _, touch in pairs])


def _velocities(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, Array]:
    """Angular velocities, rad/s, and velocities of the centres, m/s, of all geoms, shape (ngeom, 3) each."""
    body = model.geom_bodyid
    turning, moving = data.cvel[body, :3], data.cvel[body, 3:]
    return turning, moving + _cross(turning, data.geom_xpos - data.subtree_com[model.body_rootid[body]])


def _cross(a: Array, b: Array) -> Array:
    """Cross products of rows; `np.cross` takes five times as long for a few."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack((y * w - z * v, z * u - x * w, x * v - y * u), axis=1)


def _along(normal: list[float], turning: list[float], lever: list[float]) -> float:
    """The part along a normal of a point's velocity by turning, m/s; three numbers are faster than arrays."""
    (a, b, c), (x, y, z), (u, v, w) = normal, turning, lever
    return a * (y * w - z * v) + b * (z * u - x * w) + c * (x * v - y * u)
