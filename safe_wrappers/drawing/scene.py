"""Marks in MuJoCo's own scene: what Gymnasium's renderer draws beside the model, in frames and in the window."""

from collections.abc import Sequence
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.drawing.marks import COLOURS, Mark

MOST_MARKS: Final = 500
"""Of one frame. Gymnasium's scene has room for 1000 shapes, the model's own among them."""

_SIZES: Final = {"arrow": np.array([1.0, 1.0, 2.0])}
"""MuJoCo draws an arrow half as long as its size says."""


def find_renderer(env: gym.Env[Any, Any]) -> Any | None:
    """The `MujocoRenderer` of an env, or of the robot's env that it holds, as a maze does; None: it has none."""
    raw: Any = env.unwrapped
    held = [raw, *(inner for inner in vars(raw).values() if isinstance(inner, gym.Env))]
    found = (getattr(one, "mujoco_renderer", None) for one in held)
    return next((renderer for renderer in found if renderer is not None), None)


def set_size(env: gym.Env[Any, Any], width: int, height: int) -> None:
    """Have an env of which no frame has been asked yet draw frames of this size, px; others stay as they are."""
    renderer = find_renderer(env)
    if renderer is not None:
        renderer.width, renderer.height = width, height
        drawn = renderer.model.vis.global_
        drawn.offwidth, drawn.offheight = width, height


def put(marks: Sequence[Mark], renderer: Any, render_mode: str) -> None:
    """Have the next frame show marks; model and data stay bit for bit as they are.

    Args:
        marks: The first `MOST_MARKS` of them are drawn.
        renderer: Found by `find_renderer`.
        render_mode: "rgb_array" or "human".
    """
    viewer = renderer._get_viewer(render_mode)
    for mark in marks[:MOST_MARKS]:
        viewer.add_marker(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{mark.shape.upper()}"),
            pos=mark.position,
            size=mark.size * _SIZES.get(mark.shape, 1.0),
            mat=mark.axes.ravel(),
            rgba=COLOURS[mark.role],
        )
