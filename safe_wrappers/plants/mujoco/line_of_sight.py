"""LineOfSight: which points a camera or a site of a MuJoCo model sees, by rays."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.plants.mujoco.model import kinematics, named

# Later versions of MuJoCo take one more argument.
_TAKES_NORMALS = "normal" in (mujoco.mj_multiRay.__doc__ or "")
_SKIN_M = 1e-9  # a surface this close in front of a point does not hide it: the point may lie on it


class LineOfSight:
    """Rays from a sensor to points, all in one call of MuJoCo.

    Every visible geom (alpha above 0) stops a ray, except those of the sensor's own body, unless
    that is the world. A ray that first meets a body, or a descendant of it, has reached the points on that body.

    Args:
        model: Of the env; only read.
        camera: Name of a camera, or None.
        site: Name of a site, or None; one of the two.
        view_deg: Full opening angle of the visible cone, degrees, around a camera's direction of view or a site's z
            axis. None: a camera's own `fovy`, all around for a site.
        range_m: Range of sight, m.

    Raises:
        UnknownNameError: No camera or site of that name; the message lists all names.
        ConfigurationError: No `view_deg` for an orthographic camera, which has no angle of view.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str | None,
        site: str | None,
        view_deg: float | None,
        range_m: float,
    ) -> None:
        self.model = model
        self.data = mujoco.MjData(model)  # kinematics and velocities of the state that was read last
        self._kind = "site" if camera is None else "cam"
        self._id = named(model, "site", site or "") if camera is None else named(model, "camera", camera)
        self.body = int(getattr(model, f"{self._kind}_bodyid")[self._id])
        if view_deg is None:
            view_deg = 360.0
            if camera is not None:
                kinds = model.cam_projection if hasattr(model, "cam_projection") else model.cam_orthographic
                if kinds[self._id]:
                    is_flat = "is orthographic: its fovy is a length, not an angle; give view_deg"
                    raise ConfigurationError(f"the camera {camera!r} {is_flat}")
                view_deg = float(model.cam_fovy[self._id])
        self._cosine = -2.0 if view_deg >= 360.0 else math.cos(math.radians(0.5 * view_deg))
        self._range = range_m
        self._inside = np.eye(model.nbody, dtype=bool)  # whether body i is body j or a descendant of it
        for body in range(1, model.nbody):
            self._inside[body] |= self._inside[model.body_parentid[body]]

    def read(self, data: mujoco.MjData) -> None:
        """Take the state of an env's data, whose own poses may lag a substep behind."""
        kinematics(self.model, data, self.data)
        mujoco.mj_camlight(self.model, self.data)

    @property
    def position(self) -> Array:
        """Of the sensor, shape (3,), m."""
        return np.array(getattr(self.data, f"{self._kind}_xpos")[self._id])

    @property
    def rotation(self) -> Array:
        """Of the sensor: its axes as columns, shape (3, 3)."""
        return np.array(getattr(self.data, f"{self._kind}_xmat")[self._id]).reshape(3, 3)

    def velocity(self, body: int) -> tuple[Array, Array]:
        """Linear velocity of a body's origin (m/s) and its angular velocity (rad/s) in world axes, (3,) each."""
        six = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, body, six, 0)
        return six[3:], six[:3]

    def sees(self, points: Array, bodies: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which points are seen, shape (n,).

        Args:
            points: Shape (n, 3), m.
            bodies: Id of the body that each point is on, which does not hide it; -1 for none; shape (n,).
        """
        eye, axis = self.position, self.rotation[:, 2] * (-1.0 if self._kind == "cam" else 1.0)
        offsets = points - eye
        lengths = np.linalg.norm(offsets, axis=1)
        seen = (lengths <= self._range) & (offsets @ axis >= lengths * self._cosine - 1e-12)
        which = np.flatnonzero(seen & (lengths > _SKIN_M))
        if not which.size:
            return np.asarray(seen)
        directions = offsets[which] / lengths[which, None]
        hit, at = np.full(which.size, -1, dtype=np.int32), np.zeros(which.size)
        normals = (None,) if _TAKES_NORMALS else ()
        own_body = self.body or -1  # a sensor on the world does not see through walls
        rays = self.model, self.data, eye, directions.reshape(-1), None, 1, own_body
        mujoco.mj_multiRay(*rays, hit, at, *normals, which.size, float(lengths[which].max()) + 1.0)
        hitting = hit >= 0
        blocker = self.model.geom_bodyid[np.where(hitting, hit, 0)]
        own = bodies[which]
        itself = (own >= 0) & self._inside[blocker, np.maximum(own, 0)]
        seen[which] = ~hitting | itself | (at >= lengths[which] - _SKIN_M)
        return np.asarray(seen)
