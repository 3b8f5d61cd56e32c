"""A plant for every env: what a spec holds of a plant is a pattern, not the plant itself."""

import copy
from typing import Any

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.plant import Plant


class PlantTemplate:
    """A plant as an env's spec keeps it: every env that is made from the spec gets one of its own."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def fresh(self) -> Plant:
        """A copy for a new env."""
        return copy.deepcopy(self._plant)


def own_plant(plant: Any) -> Plant | None:
    """The plant that was given, a fresh one if it comes from a spec, or an error if it is none."""
    if isinstance(plant, PlantTemplate):
        return plant.fresh()
    if plant is not None and not isinstance(plant, Plant):
        raise ConfigurationError(
            f"plant is a MujocoPlant, an AnalyticPlant or another subclass of sw.Plant, got {plant!r}"
        )
    return plant
