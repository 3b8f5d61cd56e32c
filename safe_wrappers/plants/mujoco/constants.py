"""Constants: the numbers of a MuJoCo model that are read once, and whether they have changed since."""

from typing import Final

import mujoco
import numpy as np

from safe_wrappers.plants.mujoco.model import Remade

_READ: Final = ("body_", "jnt_", "dof_", "geom_", "site_", "actuator_", "eq_", "tendon_", "pair_", "qpos")
_DRAWN: Final = ("_rgba", "_group", "_matid", "_user")
DYNAMICS: Final = (
    *("body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_damping", "dof_frictionloss"),
    *("jnt_range", "jnt_stiffness", "geom_size", "geom_friction"),
    *("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange"),
)
"""What is compared at every step: masses, friction, joints and motors."""
PLACES: Final = ("body_pos", "geom_pos")
"""Likewise, where fixed bodies and geoms are."""


def read_fields(model: mujoco.MjModel) -> list[str]:
    """The model's arrays of numbers that a plant or a constraint may read; colours and names are not."""
    return [
        name
        for name in dir(model)
        if name.startswith(_READ)
        and not name.endswith(_DRAWN)
        and isinstance(getattr(model, name), np.ndarray)
    ]


def different_fields(model: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    """The arrays, and options of the physics, in which two models differ."""
    found = [n for n in read_fields(model) if not np.array_equal(getattr(model, n), getattr(other, n))]
    options = [n for n in dir(model.opt) if not n.startswith("_")]
    return found + [
        f"opt.{n}" for n in options if not np.array_equal(getattr(model.opt, n), getattr(other.opt, n))
    ]


class Constants(Remade):
    """Compares some arrays of a model with what they were, by their bytes.

    Args:
        model: Watched; it is not copied.
        fields: Names of its arrays.
    """

    def __init__(self, model: mujoco.MjModel, fields: tuple[str, ...]) -> None:
        self._options = model.opt
        arrays = [getattr(model, name) for name in fields]
        self._views = [array.reshape(-1).view(np.uint8).data for array in arrays if array.size]
        self._seen = self._now()

    def _now(self) -> tuple[float, int, bytes]:
        return self._options.timestep, self._options.disableflags, b"".join(self._views)

    def changed(self) -> bool:
        """Whether they are not what they were when this was made, or at the last call."""
        before, self._seen = self._seen, self._now()
        return before != self._seen
