"""Proposed and executed action as arrows, where an action is a push or a displacement in space."""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from safe_wrappers.drawing.marks import Array, Mark, arrow
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

_MOST_ACTUATORS: Final = 2
"""An arrow shows two numbers: machines with more actuators have bars alone."""
_LENGTH: Final = 0.12
"""Of the longest arrow, in shares of the model's extent."""


def arrows(plant: Plant, specs: Iterable[Any], proposed: Array, executed: Array) -> list[Mark]:
    """Two arrows at a machine, the executed one above; none where it is not known which way an action goes.

    Args:
        plant: After it has observed.
        specs: Constraints; the first body that one of them names is pushed.
        proposed: Action, shape (m,).
        executed: Likewise.
    """
    if isinstance(plant, DisplacementPlant):
        at, _ = plant.motion("body", plant.gripper)
        ways = np.eye(3, plant.lower.size)
    elif isinstance(plant, MujocoPlant) and plant.has_acceleration and plant.lower.size <= _MOST_ACTUATORS:
        bodies = (getattr(spec, "body", None) or next(iter(getattr(spec, "bodies", ())), None) for spec in specs)
        body = next((name for name in bodies if name), _only_body(plant))
        if body is None:
            return []
        at, _, _, ways = plant.point("body", body)
    else:
        return []
    # The longest push of a corner of the box has the full length.
    reach = float(np.linalg.norm(np.abs(ways) @ np.maximum(np.abs(plant.lower), np.abs(plant.upper))))
    if not (0.0 < reach < np.inf):
        return []
    length = _LENGTH * float(plant.model.stat.extent)
    found = []
    for role, action, lift, thick in (("proposed", proposed, 1.0, 0.06), ("executed", executed, 1.6, 0.06)):
        vector = ways @ np.clip(action, plant.lower, plant.upper) * (length / reach)
        if float(np.linalg.norm(vector)) > 0.02 * length:
            raised = at + np.array([0.0, 0.0, lift * 2.0 * thick * length])
            found.append(arrow(role, raised, vector, thick * length))  # type: ignore[arg-type]
    return found


def _only_body(plant: MujocoPlant) -> str | None:
    """The body that moves, if there is one alone."""
    moving = sorted({int(plant.model.jnt_bodyid[j]) for j in range(plant.model.njnt)})
    return plant.model.body(moving[0]).name or None if len(moving) == 1 else None
