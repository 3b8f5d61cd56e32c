"""A camera that keeps the robot in sight."""

from __future__ import annotations

from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.drawing.scene import find_renderer

_SEEN: Final = 0.6
"""Share of the picture, about its middle, in which a robot is kept: words and strips are near the edges."""


def robot_root(model: mujoco.MjModel) -> int | None:
    """The root body of what the first actuator moves; None where it moves no joint, site or body."""
    kinds = mujoco.mjtTrn
    for i in range(model.nu):
        kind, at = model.actuator_trntype[i], model.actuator_trnid[i, 0]
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            return int(model.body_rootid[model.jnt_bodyid[at]])
        if kind == kinds.mjTRN_SITE:
            return int(model.body_rootid[model.site_bodyid[at]])
        if kind == kinds.mjTRN_BODY:
            return int(model.body_rootid[at])
    return None


class InSight(gym.Wrapper[Any, Any, Any, Any]):
    """Frames in which the robot stays in sight: the free camera moves sideways by as little as that takes.

    Fixed cameras stay where they are, and so does the picture of an env that MuJoCo does not draw.

    Args:
        env: Makes frames (render mode "rgb_array").
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._home: NDArray[np.float64] | None = None

    def render(self) -> Any:
        """The env's frame."""
        renderer = find_renderer(self.env)
        if renderer is not None and renderer.camera_id in (None, -1):
            root = robot_root(renderer.model)
            viewer = renderer._get_viewer(str(self.render_mode))
            # Half of what a frame costs without a graphics card.
            viewer.scn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            camera = viewer.cam
            if self._home is None:
                self._home = camera.lookat.copy()
            if root is not None:
                aspect = renderer.width / renderer.height
                robot = renderer.data.subtree_com[root]
                camera.lookat[:] = self._home + _aside(renderer.model, camera, self._home, robot, aspect)
        return self.env.render()


def _aside(
    model: mujoco.MjModel, camera: Any, home: NDArray[np.float64], robot: NDArray[np.float64], aspect: float
) -> NDArray[np.float64]:
    """By how much, m, a camera has to look beside a point so that the robot is inside the picture's middle."""
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ahead = np.cos(elevation) * flat + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.array([flat[1], -flat[0], 0.0])
    offset = robot - (home - camera.distance * ahead)
    half = max(offset @ ahead, 0.0) * np.tan(np.radians(model.vis.global_.fovy) / 2.0)
    aside = np.zeros(3)
    for axis, reach in ((right, half * aspect), (np.cross(right, ahead), half)):
        place = offset @ axis
        aside += (place - np.clip(place, -_SEEN * reach, _SEEN * reach)) * axis
    return aside
