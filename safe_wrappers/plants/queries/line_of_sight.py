"""LineOfSight: which points a camera or a site of a MuJoCo model sees, by rays; all of them in one call."""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError, UnknownNameError

Array = NDArray[np.float64]

_TAKES_NORMALS = "normal" in (mujoco.mj_multiRay.__doc__ or "")
"""MuJoCo's later versions want one argument more."""
_SKIN_M = 1e-9
"""A surface that is this close before the point does not hide it: the point may lie on it."""


class LineOfSight:
    """Rays from a sensor to points, as the model's geoms stop them.

    MuJoCo's rays hit every visible geom (alpha above 0) of the groups asked for, but none of the body that the sensor
    sits on (a sensor on the world sees the world's geoms, too). A ray that meets what moves with a tracked body,
    before anything else, has found it.

    Args:
        model: Of the env; only read.
        camera: Name of a camera, or None.
        site: Name of a site, or None; one of the two.
        view_deg: Full opening angle of the cone that is seen, degrees: around a camera's direction of view, around a
            site's z axis. None: a camera's own `fovy`; all around for a site.
        range_m: Farther away nothing is seen, m.
        groups: Geom groups (0 to 5) that stop rays; None: all.

    Raises:
        UnknownNameError: No camera or site of that name; the message lists those there are.
        ConfigurationError: No `view_deg` for a camera that has no angle of view, being orthographic.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str | None,
        site: str | None,
        view_deg: float | None,
        range_m: float,
        groups: Sequence[int] | None,
    ) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        """At the state of the last `look`: kinematics and velocities."""
        self._is_camera = camera is not None
        if camera is not None:
            self._id = named(model, "camera", camera)
            self.body = int(model.cam_bodyid[self._id])
            if view_deg is None:
                view_deg = _angle_of_view(model, self._id)
        else:
            self._id = named(model, "site", site or "")
            self.body = int(model.site_bodyid[self._id])
            view_deg = 360.0 if view_deg is None else view_deg
        self._cosine = math.cos(math.radians(0.5 * min(view_deg, 360.0)))
        self._all_around = view_deg >= 360.0
        self._range = range_m
        self._groups: Any = None
        if groups is not None:
            self._groups = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
            self._groups[list(groups)] = 1
        self._root = _ancestors(model)

    def read(self, data: mujoco.MjData) -> None:
        """Take a state: MuJoCo's own positions lag a substep behind it after a step, these do not."""
        mine = self.data
        mine.qpos[:], mine.qvel[:] = data.qpos, data.qvel
        if self.model.nmocap:
            mine.mocap_pos[:], mine.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self.model, mine)
        mujoco.mj_comPos(self.model, mine)
        mujoco.mj_camlight(self.model, mine)
        mujoco.mj_comVel(self.model, mine)

    @property
    def position(self) -> Array:
        """Of the sensor, shape (3,), m."""
        return np.array(self.data.cam_xpos[self._id] if self._is_camera else self.data.site_xpos[self._id])

    @property
    def rotation(self) -> Array:
        """Of the sensor: its axes as columns, shape (3, 3)."""
        flat = self.data.cam_xmat[self._id] if self._is_camera else self.data.site_xmat[self._id]
        return np.array(flat).reshape(3, 3)

    def velocity(self, body: int) -> tuple[Array, Array]:
        """Linear velocity of a body's origin (m/s) and its angular velocity (rad/s) in world axes, (3,) each."""
        six = np.zeros(6)
        kind = mujoco.mjtObj.mjOBJ_XBODY
        mujoco.mj_objectVelocity(self.model, self.data, kind, body, six, 0)
        return six[3:], six[:3]

    def sees(self, points: Array, bodies: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which points are seen.

        Args:
            points: Shape (n, 3), m.
            bodies: The body that each of them sits on, which does not hide it; -1 for none; shape (n,).

        Returns:
            Shape (n,).
        """
        eye = self.position
        offsets = points - eye
        lengths = np.sqrt((offsets * offsets).sum(axis=1))
        seen = lengths <= self._range
        if not self._all_around:
            axis = self.rotation[:, 2] * (-1.0 if self._is_camera else 1.0)
            seen &= offsets @ axis >= lengths * self._cosine - 1e-12
        which = np.flatnonzero(seen & (lengths > _SKIN_M))
        if not which.size:
            return np.asarray(seen)
        directions = offsets[which] / lengths[which, None]
        hit, at = np.full(which.size, -1, dtype=np.int32), np.zeros(which.size)
        normals = (None,) if _TAKES_NORMALS else ()
        mujoco.mj_multiRay(
            self.model,
            self.data,
            eye,
            directions.reshape(-1),
            self._groups,
            1,
            self.body or -1,  # the world is no housing of the sensor: its walls hide things
            hit,
            at,
            *normals,
            which.size,
            float(lengths[which].max()) + 1.0,
        )
        hitting = hit >= 0
        blocker = self.model.geom_bodyid[np.where(hitting, hit, 0)]
        own = bodies[which]
        itself = (own >= 0) & self._root[blocker, np.maximum(own, 0)]
        seen[which] = ~hitting | itself | (at >= lengths[which] - _SKIN_M)
        return np.asarray(seen)


def _angle_of_view(model: mujoco.MjModel, camera: int) -> float:
    """A camera's own, degrees."""
    flat = model.cam_projection if hasattr(model, "cam_projection") else model.cam_orthographic
    if flat[camera]:
        raise ConfigurationError(
            f"the camera {model.camera(camera).name!r} is orthographic: its fovy is a length, not an angle; give "
            "view_deg"
        )
    return float(model.cam_fovy[camera])


def named(model: mujoco.MjModel, kind: str, name: str) -> int:
    """The id of a camera, site or body, or an error that lists those there are."""
    types = {
        "camera": (mujoco.mjtObj.mjOBJ_CAMERA, model.ncam),
        "site": (mujoco.mjtObj.mjOBJ_SITE, model.nsite),
        "body": (mujoco.mjtObj.mjOBJ_BODY, model.nbody),
    }
    which, count = types[kind]
    found = mujoco.mj_name2id(model, which, name)
    if found < 0:
        there = [mujoco.mj_id2name(model, which, i) for i in range(count)]
        listed = ", ".join(n for n in there if n) or "none"
        raise UnknownNameError(f"the model has no {kind} {name!r}; it has: {listed}")
    return int(found)


def _ancestors(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Whether body i is body j or moves with it as its descendant, shape (nbody, nbody)."""
    inside = np.eye(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        inside[body] |= inside[model.body_parentid[body]]
    return inside
