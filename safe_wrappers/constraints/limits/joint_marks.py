"""How limits of joints look: where a link would be at the ends of its range, and its speed beside the largest one."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.drawing.marks import Mark, arrow, ball, line, pad, segment
from safe_wrappers.plants.mujoco.model import SLIDE
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_SHORTEST: Final = 0.08
"""Of what is drawn at a joint, in sizes of the model."""
_LONGER: Final = 1.5
"""Than the way from a hinge to its link's centre of mass."""
_FASTEST: Final = 0.5 * np.pi
"""rad: the arc of a hinge at its largest speed."""
_RODS: Final = 6
"""Of an arc."""


def range_marks(plant: MujocoPlant, joints: Sequence[int], low: Array, high: Array) -> list[Mark]:
    """Where each joint is, yellow, between the ends that it has, red; rods at hinges, squares across slides.

    Args:
        plant: After it has observed.
        joints: Ids of hinges and slides, n of them.
        low: Smallest positions, rad or m, shape (n,); -inf where there is no end.
        high: Largest, likewise.
    """
    found: list[Mark] = []
    for j, ends in zip(joints, np.stack([low, high], axis=1), strict=True):
        at, axis, q, out, size = _joint(plant, j)
        finite = [float(end) for end in ends if np.isfinite(end)]
        if out is None:
            here = at + axis * (q - plant.model.qpos0[plant.model.jnt_qposadr[j]])
            found.append(ball("way", here, 0.1 * size))
            found += [pad("limit", here + axis * (end - q), axis, 0.5 * size) for end in finite]
        else:
            found.append(segment("way", at, at + out, 0.03 * size))
            found += [segment("limit", at, at + _turned(out, axis, end - q), 0.02 * size) for end in finite]
    return found


def speed_marks(plant: MujocoPlant, joints: Sequence[int], limits: Array) -> list[Mark]:
    """Each joint's speed, yellow, which reaches one of the red balls at its limit: an arc at hinges, or an arrow.

    Args:
        plant: After it has observed.
        joints: Ids of hinges and slides, n of them.
        limits: Largest speeds, rad/s or m/s, shape (n,).
    """
    found: list[Mark] = []
    for j, limit in zip(joints, limits.tolist(), strict=True):
        at, axis, q, out, size = _joint(plant, j)
        share = float(plant.qvel[plant.model.jnt_dofadr[j]]) / limit
        if out is None:
            at = at + axis * (q - plant.model.qpos0[plant.model.jnt_qposadr[j]])
            tips = [at + way * axis * size for way in (-1.0, 1.0)]
            found.append(arrow("way", at, share * size * axis, 0.04 * size))
        else:
            tips = [at + _turned(out, axis, way * _FASTEST) for way in (-1.0, 1.0)]
            angles = np.linspace(0.0, share * _FASTEST, _RODS + 1)
            found += line("way", [at + _turned(out, axis, angle) for angle in angles], 0.04 * size)
        found += [ball("limit", tip, 0.08 * size) for tip in tips]
    return found


def _joint(plant: MujocoPlant, j: int) -> tuple[Array, Array, float, Array | None, float]:
    """Anchor (of a slide at `qpos0`), m; axis; position; a hinge's link from its axis outwards; size, m."""
    model, data = plant.model, plant.forward()
    at, axis = data.xanchor[j].copy(), data.xaxis[j].copy()
    q, size = float(plant.qpos[model.jnt_qposadr[j]]), _SHORTEST * float(model.stat.extent)
    if model.jnt_type[j] == SLIDE:
        return at, axis, q, None, size
    body = int(model.jnt_bodyid[j])
    out = data.xipos[body] - at
    out = out - (out @ axis) * axis
    length = float(np.linalg.norm(out))
    if length < 1e-6:  # it turns about its own centre: any direction that turns with it
        frame = data.xmat[body].reshape(3, 3)
        out = frame[:, int(np.abs(axis @ frame).argmin())]
        out = out - (out @ axis) * axis
    else:
        size = max(size, _LONGER * length)
    return at, axis, q, out * (size / float(np.linalg.norm(out))), size


def _turned(vector: Array, axis: Array, angle: float) -> Array:
    """A vector perpendicular to an axis of length 1, turned about it, rad."""
    return np.asarray(np.cos(angle) * vector + np.sin(angle) * np.cross(axis, vector))
