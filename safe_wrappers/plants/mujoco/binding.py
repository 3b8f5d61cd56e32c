"""What a `MujocoPlant` needs of an env: a model to copy, the length of a step, actions that are controls."""

import copy
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array, positive
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of

ModelOf = Callable[[Any], mujoco.MjModel]
"""Takes the unwrapped env; returns its model."""
DataOf = Callable[[Any], mujoco.MjData]
"""Takes the unwrapped env; returns its data."""

_LAST_INTEGRATOR = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


class Accessed:
    """An unwrapped env whose model and data are found by functions of it, here as `.model` and `.data`."""

    def __init__(self, raw: Any, model: ModelOf | None, data: DataOf | None) -> None:
        self._raw, self._functions = raw, (model, data)

    def on(self, raw: Any) -> "Accessed":
        """The same functions on another env."""
        return Accessed(raw, *self._functions)

    @property
    def model(self) -> mujoco.MjModel:
        """The env's model."""
        return self._found("model", self._functions[0], mujoco.MjModel)

    @property
    def data(self) -> mujoco.MjData:
        """The env's data."""
        return self._found("data", self._functions[1], mujoco.MjData)

    def _found(self, name: str, function: Callable[[Any], Any] | None, kind: type) -> Any:
        found = getattr(self._raw, name, None) if function is None else function
        found = found(self._raw) if callable(found) else found
        if not isinstance(found, kind):
            raise ConfigurationError(
                f"MujocoPlant({name}=...) is a function of the unwrapped env that returns its "
                f"mujoco.{kind.__name__}; of {self._raw} it returned {type(found).__module__}.{type(found).__name__} "
                f"(what wraps MuJoCo's own often has it inside: env.physics.{name}.ptr, env.sim.{name}._{name})"
            )
        return found


def checked_model(source: Any, given: mujoco.MjModel | None) -> mujoco.MjModel:
    """The env's own model, or a copy of the given one; or an error that says why a plant cannot use it."""
    if not isinstance(getattr(source, "model", None), mujoco.MjModel) or not hasattr(source, "data"):
        raise UnsupportedEnvError(
            f"{source} has no MuJoCo .model and .data; describe it with AnalyticPlant(f=..., g=..., state=...) "
            "instead, or say where it keeps them: MujocoPlant(model=lambda env: ..., data=lambda env: ...)"
        )
    model: mujoco.MjModel = source.model if given is None else copy.copy(given)
    wanted, sizes = ((m.nq, m.nv, m.nu) for m in (source.model, model))
    if sizes != wanted:
        must = "the plant's model must have the env's joints and actuators"
        raise ConfigurationError(f"{must}: expected (nq, nv, nu) = {wanted}, got {sizes}")
    expected, timestep = source.model.opt.timestep, model.opt.timestep
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


def physics_steps(raw: Any, source: Any = None, control_dt: float | None = None) -> int:
    """How many physics substeps an unwrapped MuJoCo env takes with one action.

    Args:
        raw: Says it by `frame_skip`, `n_substeps` or `dt` (s), or holds the env that steps its physics and says it.
            Where functions find its data, by `dt` alone: what else it counts may be other steps.
        source: Has its `.model` and `.data`; None: the env itself.
        control_dt: How long it holds an action, s, for an env that does not say so.

    Raises:
        UnsupportedEnvError: Nobody says it.
        ConfigurationError: `control_dt` is no whole number of physics steps, or not the env's.
    """
    source = raw if source is None else source
    env, names = raw, ("frame_skip", "n_substeps") if source is raw else ()
    if names and not hasattr(raw, "frame_skip"):
        # The physics may be stepped by an env that this one holds: a maze holds its robot's.
        held = (e for e in vars(raw).values() if isinstance(e, gym.Env))
        env = next((e for e in held if getattr(e, "data", None) is raw.data), raw)
    timestep = float(source.model.opt.timestep)
    said = next((int(getattr(env, n)) for n in names if getattr(env, n, None) is not None), None)
    if said is None and getattr(env, "dt", None) is not None:
        said = round(float(env.dt) / timestep)
    if control_dt is None:
        if said is None:
            raise UnsupportedEnvError(
                f"{raw} does not say how long a step lasts: give it an attribute dt (s) or frame_skip (physics "
                "steps), or pass MujocoPlant(control_dt=...), in seconds"
            )
        return said
    steps = positive("control_dt", control_dt, "s") / timestep
    if round(steps) < 1 or not np.isclose(steps, round(steps), rtol=1e-6):
        raise ConfigurationError(
            f"control_dt = {control_dt} s is not a whole number of physics steps of {timestep} s: {steps:g}"
        )
    if said not in (None, round(steps)):
        raise ConfigurationError(
            f"control_dt = {control_dt} s is {round(steps)} physics steps of {timestep} s, but {raw} takes {said} "
            "with one action: leave control_dt out"
        )
    return round(steps)


def actions_are_controls(space: gym.Space[Any], lower: Array, upper: Array) -> bool:
    """Whether an action space is the model's control range, shapes (nu,), where there is one."""
    limited = np.isfinite(lower)
    rounding = 0.5e-6 * (upper - lower)[limited]
    return (
        isinstance(space, gym.spaces.Box)
        and space.shape == lower.shape
        and np.allclose(space.low[limited], lower[limited], atol=rounding)
        and np.allclose(space.high[limited], upper[limited], atol=rounding)
    )


def refuse_other_actions(env: gym.Env[Any, Any], lower: Array, upper: Array) -> None:
    """Refuse an action space that no map of its entries makes the model's control range, shapes (nu,)."""
    space = env.action_space
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
    if space.shape != lower.shape:
        raise UnsupportedEnvError(
            f"{name_of(env)} rescales or limits actions in its own step: it has not one action for each control. Use "
            f"AnalyticPlant(f=..., g=..., state=...) with your own f and g: {ranges}"
        )


def moves_by_displacement(raw: Any) -> bool:
    """Whether an unwrapped env is of the Fetch kind: one mocap body welded to the gripper, four actions."""
    model, space = getattr(raw, "model", None), getattr(raw, "action_space", None)
    return (
        isinstance(model, mujoco.MjModel)
        and isinstance(space, gym.spaces.Box)
        and space.shape == (4,)
        and hasattr(raw, "block_gripper")
        and hasattr(raw, "n_substeps")
        and len(welds(model)) == model.nmocap == 1
    )


def welds(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Mocap bodies (their mocap ids) and the bodies welded to them."""
    weld = model.eq_type == int(mujoco.mjtEq.mjEQ_WELD)
    pairs = zip(model.eq_obj1id[weld].tolist(), model.eq_obj2id[weld].tolist(), strict=True)
    mocap = model.body_mocapid.tolist()
    both = (pair for first, second in pairs for pair in ((first, second), (second, first)))
    return [(mocap[one], other) for one, other in both if mocap[one] >= 0 and mocap[other] < 0]
