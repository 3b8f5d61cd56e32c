"""What acts when no admissible action is known: brake, hold, zero, or the user's own."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.control.projection import box_least_squares
from safe_wrappers.errors import Array, ConfigurationError, UnknownNameError, float_array
from safe_wrappers.filter.bound import Bound
from safe_wrappers.plants.mujoco.model import inertia
from safe_wrappers.plants.plant import Plant

FallbackFunction = Callable[[Plant], ArrayLike]
"""The user's own: takes the plant at its present state, returns a control of shape (m,)."""

NAMES = ("brake", "hold", "zero")


class Fallback:
    """Chooses a finite control inside the box, whatever happens.

    Args:
        choice: "brake" takes the motion away as fast as the actuators can: by the first `backup` of a constraint,
            else by `brake` on a MujocoPlant, else by the control that violates the rows least. "hold" repeats the
            last executed action; "zero" is no control; or a function of the plant.
        constraints: Whose backups "brake" uses.

    Raises:
        UnknownNameError: No fallback of that name.
    """

    def __init__(self, choice: str | FallbackFunction, constraints: Sequence[Bound] = ()) -> None:
        if not callable(choice) and choice not in NAMES:
            names = ", ".join(NAMES)
            raise UnknownNameError(f"no fallback {choice!r}; choose {names}, or pass a function of the plant")
        self._choice, self._constraints = choice, constraints
        self.brakes, self.custom = choice == "brake", callable(choice)

    def __call__(
        self, plant: Plant | None, last: Array, low: Array, high: Array, least: Array | None, readable: bool
    ) -> Array:
        """The control, finite and clipped to the box; one that is not finite is replaced by zero.

        Args:
            plant: Observed; "hold" and "zero" need none.
            last: What was executed before, shape (m,).
            low: Action box, shape (m,).
            high: Likewise.
            least: The control that violates the rows least, if one is known.
            readable: False if the state is not a number: then there is no motion to brake.
        """
        if callable(self._choice):
            assert plant is not None
            control = float_array("the fallback's control", self._choice(plant))
            if control.shape != low.shape:
                wanted = f"the fallback must return a control of shape {low.shape}"
                raise ConfigurationError(f"{wanted}, got {control.shape}")
        elif self._choice == "hold":
            control = last
        elif self._choice == "zero" or not readable:
            control = np.zeros_like(low)
        else:
            control = self._brake(plant, np.zeros_like(low) if least is None else least)
        if not np.isfinite(control).all():
            control = np.zeros_like(low)
        return np.clip(control, low, high)

    def _brake(self, plant: Plant | None, least: Array) -> Array:
        backup = next((b for c in self._constraints if (b := c.backup()) is not None), None)
        if backup is not None:
            return np.asarray(backup, dtype=np.float64)
        return brake(plant) if plant is not None and plant.can_brake else least


def brake(plant: Any) -> Array:
    """The control that leaves the least kinetic energy at the end of the hold, in the linear model, shape (m,).

    Energies are counted joint by joint (the diagonal of the inertia). A small weight on the control settles actuators
    that do not matter. Best effort: it does not balance. A plant whose controls are no forces brakes as its forecasts
    do.
    """
    if not plant.has_acceleration:
        return np.asarray(plant.braking())
    drift, effect = plant.acceleration
    weight = np.sqrt(np.diag(inertia(plant.model, plant.forward())))
    a = effect * weight[:, None]
    scale = float(np.sqrt((a * a).sum(axis=0).max(initial=1e-12)))
    low, high = plant.acting_range
    stacked = np.vstack([a / scale, 1e-4 * np.eye(low.size)])
    aim = np.concatenate([-(plant.qvel / plant.control_dt + drift) * weight / scale, np.zeros(low.size)])
    return box_least_squares(stacked, aim, low, high)
