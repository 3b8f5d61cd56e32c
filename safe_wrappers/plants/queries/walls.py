"""The walls of a maze in a MuJoCo model: the fixed boxes that a body moving in the plane can touch."""

import mujoco
import numpy as np

from safe_wrappers.control.numerics.rectangles import Rectangle, merged
from safe_wrappers.errors import UnsupportedEnvError

_ALIGNED = 1e-6
_PLANE, _BOX = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_BOX)


def walls(model: mujoco.MjModel, body: int) -> tuple[list[Rectangle], float]:
    """Everything fixed that a body, given by its index, can touch as it slides along x and y without turning.

    Level floors and geoms wholly above or below the body are left out.

    Returns:
        The walls, touching ones joined, m, and the distance of the body's origin from a wall at which MuJoCo reports
        a contact, m: the body's radius and both contact margins.

    Raises:
        UnsupportedEnvError: No geom of the body collides with anything, or something it can touch moves or is not an
            upright box along x and y.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    welded = model.body_weldid[model.geom_bodyid]
    carried = model.body_mocapid[model.body_rootid[model.geom_bodyid]] >= 0
    own = np.flatnonzero((welded == body) & ((model.geom_contype > 0) | (model.geom_conaffinity > 0)))
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
        if not any(_collide(model, int(g), int(o)) for o in own):
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


def _collide(m: mujoco.MjModel, a: int, b: int) -> bool:
    types, affinities = m.geom_contype, m.geom_conaffinity
    return bool(types[a] & affinities[b] or types[b] & affinities[a])
