"""Which plant describes an env, where the user names none."""

from typing import Any

import gymnasium as gym

from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.mujoco.displacement_step import moves_by_displacement
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant


def plant_of_the_present(plant: Plant, env: gym.Env[Any, Any]) -> Plant:
    """One on the env's own model and without delay in place of a MujocoPlant, bound; any other plant as it is."""
    if not isinstance(plant, MujocoPlant):
        return plant
    present = default_plant(env)
    present.bind(env)
    return present


def default_plant(env: gym.Env[Any, Any]) -> MujocoPlant:
    """A `DisplacementPlant` for envs of the Fetch kind, else a `MujocoPlant`; not bound yet."""
    return DisplacementPlant() if moves_by_displacement(env.unwrapped) else MujocoPlant()
