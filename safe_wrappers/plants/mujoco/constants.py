"""Constants: the numbers of a MuJoCo model that are read once, and whether they have changed since."""

import operator
from collections.abc import Sequence
from typing import Any, Final

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
    one, two = model.opt, other.opt
    return found + [
        f"opt.{n}" for n in option_fields(model) if not np.array_equal(getattr(one, n), getattr(two, n))
    ]


def option_fields(model: mujoco.MjModel) -> list[str]:
    """The options of the physics: gravity, wind, flags, integrator, ..."""
    return [name for name in dir(model.opt) if not name.startswith("_")]


def every_constant(model: mujoco.MjModel) -> "Constants":
    """All arrays of numbers, and all options."""
    return Constants(model, read_fields(model), option_fields(model))


class Constants(Remade):
    """Compares some arrays of a model with what they were, by their bytes.

    Args:
        model: Watched; it is not copied.
        fields: Names of its arrays.
        options: Names of options of the physics.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        fields: Sequence[str],
        options: Sequence[str] = ("timestep", "disableflags"),
    ) -> None:
        values = {name: getattr(model.opt, name) for name in options}
        arrays = [getattr(model, name) for name in fields]
        arrays += [value for value in values.values() if isinstance(value, np.ndarray)]
        numbers = [name for name, value in values.items() if not isinstance(value, np.ndarray)]
        self._options, self._numbers = model.opt, operator.attrgetter(*numbers)
        self._views = [array.reshape(-1).view(np.uint8).data for array in arrays if array.size]
        self._seen = self._now()

    def _now(self) -> tuple[Any, bytes]:
        return self._numbers(self._options), b"".join(self._views)

    def changed(self) -> bool:
        """Whether they are not what they were when this was made, or at the last call."""
        before, self._seen = self._seen, self._now()
        return before != self._seen
