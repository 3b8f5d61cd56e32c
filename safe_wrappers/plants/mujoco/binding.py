"""What a `MujocoPlant` needs of an env: a model to copy, the length of a step, actions that are controls."""

import copy
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.mujoco.displacement_step import moves_by_displacement

_LAST_INTEGRATOR = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


def own_model(raw: Any, given: mujoco.MjModel | None) -> mujoco.MjModel:
    """A copy of the given model, or of an unwrapped env's, or an error that says why a plant cannot use it."""
    if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
        raise UnsupportedEnvError(
            f"{raw} has no MuJoCo .model and .data; describe it with AnalyticPlant(f=..., g=..., state=...) instead"
        )
    model = copy.copy(given if given is not None else raw.model)
    wanted, sizes = ((m.nq, m.nv, m.nu) for m in (raw.model, model))
    if sizes != wanted:
        must = "the plant's model must have the env's joints and actuators"
        raise ConfigurationError(f"{must}: expected (nq, nv, nu) = {wanted}, got {sizes}")
    expected, timestep = raw.model.opt.timestep, model.opt.timestep
    if not np.isclose(timestep, expected, rtol=1e-9):
        must = "the plant's model must take the env's physics steps"
        raise ConfigurationError(f"{must}: expected a timestep of {expected} s, got {timestep} s")
    if model.opt.integrator > _LAST_INTEGRATOR:
        raise UnsupportedEnvError(
            "the model's integrator is 'discrete' (MuJoCo 3.13 and later), whose accelerations are those of a "
            "whole step, which MujocoPlant's g is not; it handles: Euler, RK4, implicit, implicitfast. Use "
            "AnalyticPlant with your own f and g."
        )
    return model


def control_interval(raw: Any) -> float:
    """How long an unwrapped MuJoCo env holds one action, s."""
    return physics_steps(raw) * float(raw.model.opt.timestep)


def physics_steps(raw: Any) -> int:
    """How many physics substeps an unwrapped MuJoCo env takes with one action."""
    env = raw
    if not hasattr(raw, "frame_skip"):
        # The physics may be stepped by an env that this one holds: a maze holds its robot's.
        held = (e for e in vars(raw).values() if isinstance(e, gym.Env))
        env = next((e for e in held if getattr(e, "data", None) is raw.data), raw)
    given = getattr(env, "frame_skip", getattr(env, "n_substeps", None))
    if given is not None:
        return int(given)
    if not hasattr(env, "dt"):
        raise UnsupportedEnvError(
            f"{raw} does not say how long a step lasts: give it an attribute dt (s) or frame_skip (physics steps)"
        )
    return round(float(env.dt) / float(raw.model.opt.timestep))


def check_action_space(env: gym.Env[Any, Any], lower: Array, upper: Array) -> None:
    """Refuse an env whose action space is not the model's control range, shapes (nu,)."""
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)  # the filter has refused every other space
    limited = np.isfinite(lower)
    rounding = 0.5e-6 * (upper - lower)[limited]
    if space.shape == lower.shape and (
        np.allclose(space.low[limited], lower[limited], atol=rounding)
        and np.allclose(space.high[limited], upper[limited], atol=rounding)
    ):
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
