"""Shapes that are drawn into an env's frames and are no part of its model."""

from collections.abc import Callable, Sequence
from typing import Any

from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer


class MarkingRenderer(MujocoRenderer):
    """Draws what another renderer draws, and markers on top: in frames and in the window alike.

    Markers lie in the renderer's scene alone. Model and data stay bit for bit as they are.

    Args:
        renderer: The env's own, of which no frame has been asked yet.
        markers: Asked at every frame for what `mujoco.mjv_initGeom` takes: ``type``, ``size``, ``pos``, ``rgba``.
    """

    def __init__(self, renderer: MujocoRenderer, markers: Callable[[], Sequence[dict[str, Any]]]) -> None:
        super().__init__(
            renderer.model,
            renderer.data,
            renderer.default_cam_config,
            renderer.width,
            renderer.height,
            renderer.max_geom,
            renderer.camera_id,
            visual_options=renderer._vopt,
        )
        self._markers = markers

    def render(self, render_mode: str | None) -> Any:
        """A frame, as `MujocoRenderer.render`."""
        viewer = self._get_viewer(render_mode)
        for marker in self._markers():
            viewer.add_marker(**marker)
        return super().render(render_mode)
