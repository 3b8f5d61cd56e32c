"""What a `MujocoPlant` asks of an env: a model that it can copy, and actions that are the model's controls."""

import copy
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.mujoco.displacement_step import moves_by_displacement

Array = NDArray[np.float64]

_LAST_INTEGRATOR = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


def own_model(raw: Any, given: mujoco.MjModel | None) -> mujoco.MjModel:
    """A copy of the given model, or of an unwrapped env's.

    Raises:
        UnsupportedEnvError: The env has no MuJoCo model, or one with the 'discrete' integrator.
        ConfigurationError: The given model is not of the env's joints, actuators and timestep.
    """
    if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
        raise UnsupportedEnvError(
            f"{raw} has no MuJoCo .model and .data; describe it with "
            "AnalyticPlant(f=..., g=..., state=...) instead"
        )
    model = copy.copy(given if given is not None else raw.model)
    if (model.nq, model.nv, model.nu) != (raw.model.nq, raw.model.nv, raw.model.nu):
        raise ConfigurationError(
            "the plant's model must have the env's joints and actuators: expected (nq, nv, nu) = "
            f"{(raw.model.nq, raw.model.nv, raw.model.nu)}, got {(model.nq, model.nv, model.nu)}"
        )
    expected, timestep = raw.model.opt.timestep, model.opt.timestep
    if not np.isclose(timestep, expected, rtol=1e-9):
        raise ConfigurationError(
            f"the plant's model must take the env's physics steps: expected a timestep of {expected} s, "
            f"got {timestep} s"
        )
    if model.opt.integrator > _LAST_INTEGRATOR:
        raise UnsupportedEnvError(
            "the model's integrator is 'discrete' (MuJoCo 3.13 and later), whose accelerations are those of a "
            "whole step, which MujocoPlant's g is not; it handles: Euler, RK4, implicit, implicitfast. Use "
            "AnalyticPlant with your own f and g."
        )
    return model


def control_range(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Smallest and largest control, shapes (nu,): ctrlrange, or -inf and inf."""
    limited = model.actuator_ctrllimited.astype(bool)
    low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
    return low, np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)


def check_action_space(env: gym.Env[Any, Any], lower: Array, upper: Array) -> None:
    """Refuse an env whose action space is not the model's control range."""
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)  # the filter has refused every other space
    limited = np.isfinite(lower)
    rounding = 0.5e-6 * (upper - lower)[limited]
    fits = space.shape == lower.shape and (
        np.allclose(space.low[limited], lower[limited], atol=rounding)
        and np.allclose(space.high[limited], upper[limited], atol=rounding)
    )
    if fits:
        return
    ranges = f"the action space is {space}, the model's control range {lower} to {upper}"
    if space != env.unwrapped.action_space:
        raise UnsupportedEnvError(
            f"a wrapper of {name_of(env)} changes its action space; the filter must be inside of that wrapper: "
            + ranges
        )
    if moves_by_displacement(env.unwrapped):
        raise UnsupportedEnvError(
            f"{name_of(env)} moves its gripper by displacements: take DisplacementPlant(), or leave plant out"
        )
    raise UnsupportedEnvError(
        f"{name_of(env)} rescales or limits actions in its own step; filters on such an env are not supported "
        f"yet, except with an AnalyticPlant(f=..., g=..., state=...) of your own: {ranges}"
    )
