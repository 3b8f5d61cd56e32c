"""Distances of two geoms of a MuJoCo model, and the normal between their nearest points."""

import mujoco
import numpy as np

from safe_wrappers.checks import Array

_FAR = 1e6  # largest distance that is measured, m
# Offsets at which a distance is measured again, m.
_BESIDE = 1e-7 * np.array(
    [[0.0, 0.0, 0.0], [1.0, 0.3, 0.2], [-0.3, 1.0, -0.5], [0.4, -0.6, 1.0], [-1.0, -0.7, -0.4]]
)
_ROUND = int(mujoco.mjtGeom.mjGEOM_CAPSULE)  # up to it: planes, height fields, spheres, capsules
_NUDGE = 1e-6  # width of the differences that give a normal, m
_NORMAL = 1e-9  # distance below which the nearest points give no normal, m


def nearest(
    model: mujoco.MjModel, data: mujoco.MjData, first: int, second: int
) -> tuple[float, Array, Array]:
    """Distance (m), the unit normal from the first geom to the second, and the nearest points of both, shape (6,).

    `data` has the geoms' poses; they are the same afterwards.
    """
    points = np.zeros(6)
    gap = geom_distance(model, data, first, second, points)
    between = points[3:] - points[:3]
    length = float(np.linalg.norm(between))
    if length < _NORMAL:
        return gap, _steepest(model, data, first, second), points
    return gap, np.asarray(between * (np.sign(gap) / length)), points


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
