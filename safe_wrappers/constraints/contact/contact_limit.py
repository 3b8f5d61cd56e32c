"""A requirement on the contact forces of one held control, judged by a forecast of them."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.filter.constraint import HalfSpaces
from safe_wrappers.filter.linearize import cut
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]

_ROUNDING = 1e-9


class ContactLimit(ABC):
    """Says of each control whether the contacts of its control step are as wanted.

    Contact forces follow the control at once, so there is no state in which the requirement holds or not, and no
    barrier: every control step is judged by itself, from a rollout of it. Nothing here looks farther.
    """

    scale = 1.0
    """What a shortfall is compared with, where constraints of several units fail at once."""

    def bind(self, plant: Plant) -> None:
        """Refuse a plant without a model to forecast with."""
        if not isinstance(plant, MujocoPlant):
            raise UnsupportedEnvError(
                f"{type(self).__name__} forecasts contact forces with a MuJoCo model; an AnalyticPlant has none"
            )
        self._plant = plant
        self.reset()

    def reset(self) -> None:
        """Forget the episode."""
        self._decided: int | None = None

    @abstractmethod
    def slacks(self, plant: MujocoPlant, control: Array) -> Array:
        """What is left of the requirement in the step of a control, shape (k,), k always the same; wanted >= 0."""

    def admits(self, plant: MujocoPlant, control: Array) -> bool:
        """Whether the contacts of this control's step are as wanted."""
        self._decided = plant.stamp
        return self.shortfall(plant, control) <= _ROUNDING

    def shortfall(self, plant: MujocoPlant, control: Array) -> float:
        """By how much it misses that; <= 0: not at all."""
        least = float(self.slacks(plant, control).min(initial=np.inf))
        return -least if least == least else np.inf

    def cut(self, plant: MujocoPlant, control: Array) -> HalfSpaces:
        """The requirement, linearised about a refused control."""
        return cut(lambda u: self.slacks(plant, u), control, plant.lower, plant.upper)

    def rows(self, plant: Any) -> HalfSpaces:
        """None: what counts is the forecast, linearised where a control has been refused."""
        return HalfSpaces.none(plant.lower.size)

    @property
    def _has_decided(self) -> bool:
        """Whether the present state is one that a control was judged at: not so right after a reset."""
        return self._decided == self._plant.stamp
