"""Marks in MuJoCo's own scene, beside the model; and proposed and executed action as arrows, where it pushes."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.drawing.marks import COLOURS, Mark, Role, arrow
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

MOST_MARKS: Final = 500
"""Of one frame. Gymnasium's scene has room for 1000 shapes, the model's own among them."""

_MOST_ACTUATORS: Final = 2
"""An arrow shows two numbers: machines with more actuators have bars alone."""
_LENGTH, _THICKNESS = 4.0, 0.3
"""Of the longest arrow, in sizes of the body."""
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


def arrows(plant: Plant, specs: Iterable[Any], proposed: Array, executed: Array) -> list[Mark]:
    """Two arrows at a machine, the executed one above; none where it is not known which way an action goes.

    Args:
        plant: After it has observed.
        specs: Constraints; the first body that one of them names is pushed.
        proposed: Action, shape (m,).
        executed: Likewise.
    """
    body: str | None
    if isinstance(plant, DisplacementPlant):
        body, ways = plant.gripper, np.eye(3, plant.lower.size)
        at, _ = plant.motion("body", body)
    elif isinstance(plant, MujocoPlant) and plant.has_acceleration and plant.lower.size <= _MOST_ACTUATORS:
        named = (
            getattr(spec, "body", None) or next(iter(getattr(spec, "bodies", ())), None) for spec in specs
        )
        body = next((name for name in named if name), _only_body(plant))
        if body is None:
            return []
        at, ways = _pushes(plant, plant.named("body", body))
    else:
        return []
    # The longest push of a corner of the box has the full length; beyond `acting_range` nothing pushes harder.
    low, high = plant.acting_range if plant.has_acceleration else (plant.lower, plant.upper)
    reach = float(np.linalg.norm(np.abs(ways) @ np.maximum(np.abs(low), np.abs(high))))
    size = float(
        plant.model.geom_rbound[plant.model.geom_bodyid == plant.named("body", body)].max(initial=0.0)
    )
    if not (0.0 < reach < np.inf and size > 0.0):
        return []
    found = []
    roles: tuple[tuple[Role, Array], ...] = ("proposed", proposed), ("executed", executed)
    for i, (role, action) in enumerate(roles):
        vector = ways @ np.clip(action, low, high) * (_LENGTH * size / reach)
        if float(np.linalg.norm(vector)) > _THICKNESS * size:  # a shorter one is all head
            over = at + np.array([0.0, 0.0, (1.0 + 0.7 * i) * size])
            found.append(arrow(role, over, vector, _THICKNESS * size))
    return found


def _pushes(plant: MujocoPlant, body: int) -> tuple[Array, Array]:
    """A body's centre of mass, m, and what each action does to its acceleration: a turn alone does not push it."""
    data, jacobian = plant.forward(), np.zeros((3, plant.model.nv))
    mujoco.mj_jacBodyCom(plant.model, data, jacobian, None, body)
    return data.xipos[body].copy(), jacobian @ plant.acceleration[1]


def _only_body(plant: MujocoPlant) -> str | None:
    """The body that moves, if there is one alone."""
    moving = sorted({int(plant.model.jnt_bodyid[j]) for j in range(plant.model.njnt)})
    return plant.model.body(moving[0]).name or None if len(moving) == 1 else None
