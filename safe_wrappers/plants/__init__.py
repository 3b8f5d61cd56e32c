"""Models of machines for the filter, read from an env at every step."""

import copy
from collections.abc import Iterable
from typing import Any

import gymnasium as gym

from safe_wrappers.control.bandwidth import ControlLoop
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.analytic import AnalyticPlant
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.mujoco.binding import moves_by_displacement
from safe_wrappers.plants.mujoco.dynamics import RigidModelCheck, rigid_model_check
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.simulator import Rollout, SimulatorPlant, View

__all__ = [
    "AnalyticPlant",
    "ControlLoop",
    "DisplacementPlant",
    "MujocoPlant",
    "Plant",
    "RigidModelCheck",
    "Rollout",
    "SimulatorPlant",
    "View",
    "rigid_model_check",
]


class PlantTemplate:
    """A plant as an env's spec keeps it: every env that is made from the spec gets a copy."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant


def own_plant(plant: Any) -> Plant | None:
    """The given plant, a copy of it if it comes from a spec, or an error if it is not a plant."""
    if isinstance(plant, PlantTemplate):
        return copy.deepcopy(plant.plant)
    if plant is not None and not isinstance(plant, Plant):
        wanted = "plant is a MujocoPlant, an AnalyticPlant or another subclass of sw.Plant"
        raise ConfigurationError(f"{wanted}, got {plant!r}")
    return plant


def default_plant(env: gym.Env[Any, Any], constraints: Iterable[Any] = ()) -> Plant:
    """Not bound yet.

    A `SimulatorPlant` where a constraint simulates, a `DisplacementPlant` for envs of the Fetch kind, else a
    `MujocoPlant`.
    """
    if any(constraint.simulates for constraint in constraints):
        return SimulatorPlant()
    return DisplacementPlant() if moves_by_displacement(env.unwrapped) else MujocoPlant()
