"""What a plant or a wrapper requires of its env: time steps, action spaces, published facts, other wrappers."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from safe_wrappers.errors import ConfigurationError, UnknownNameError, positive

_REPEATS = ("StickyAction", "MaxAndSkipObservation", "RepeatAction")


def read_attribute(env: gym.Env[Any, Any], name: str) -> Any:
    """`env.get_wrapper_attr(name)` with an error that lists what the env publishes."""
    try:
        return env.get_wrapper_attr(name)
    except AttributeError:
        there = ", ".join(n for n in dir(env.unwrapped) if not n.startswith("_"))
        raise UnknownNameError(f"the env publishes no attribute {name!r}; it has: {there}") from None


def refuse_second_env(bound: gym.Env[Any, Any] | None, env: gym.Env[Any, Any]) -> None:
    """Refuse a plant that is bound already: shared by two filters, one of them would read the wrong machine."""
    if bound is not None and bound.unwrapped is not env.unwrapped:
        raise ConfigurationError(
            "this plant is bound to another env already; give every filter a plant of its own (in a vector env, "
            "make it inside the function that makes the env)"
        )


def wrappers_of(env: gym.Env[Any, Any]) -> Iterator[Any]:
    """All wrappers of an env, the outermost first."""
    inner: Any = env
    while isinstance(inner, gym.Wrapper):
        yield inner
        inner = inner.env


def name_of(env: gym.Env[Any, Any]) -> str:
    """What to call an env in a message: its id, else its repr."""
    spec = env.unwrapped.spec
    return spec.id if spec is not None else repr(env.unwrapped)


def refuse_changed_actions(env: gym.Env[Any, Any]) -> None:
    """Refuse wrappers inside the filter that change, repeat or drop the action it has checked."""
    for inner in wrappers_of(env):
        if isinstance(inner, gym.ActionWrapper) or type(inner).__name__ in _REPEATS:
            raise ConfigurationError(
                f"{type(inner).__name__} inside the filter changes the actions that the filter has checked; "
                "put it outside (filter first, then this wrapper), so that the filter has the last word"
            )


def check_timing(env: gym.Env[Any, Any], control_dt: float | None = None) -> float:
    """How long one action is held, s: the env's `dt`, or `control_dt` where the env has none; both must agree."""
    try:
        dt = float(env.get_wrapper_attr("dt"))
    except (AttributeError, TypeError, ValueError):
        if control_dt is None:
            raise ConfigurationError(
                f"{name_of(env)} does not say how long a step lasts (it has no attribute dt): pass control_dt, in "
                "seconds, to a filter's plant, or give the env one, such as env.unwrapped.dt = 0.05"
            ) from None
        return control_dt
    hold = positive("the env's dt", dt, "s") if control_dt is None else control_dt
    if not np.isclose(dt, hold, rtol=1e-6):
        raise ConfigurationError(
            f"control_dt = {hold} s, but one step of this env lasts dt = {dt} s; a filter that looks ahead by "
            "another interval than the env's promises nothing: pass control_dt equal to env.unwrapped.dt"
        )
    return hold


def check_actions(env: gym.Env[Any, Any]) -> gym.spaces.Box:
    """The env's action space, refused unless it is a one-dimensional, floating Box."""
    space = env.action_space
    if (
        isinstance(space, gym.spaces.Box)
        and len(space.shape) == 1
        and np.issubdtype(space.dtype, np.floating)
    ):
        return space
    if isinstance(space, gym.spaces.Discrete):
        remedy = "Use ActionShield(env, [PredictiveShield(...)]), which tries every action"
    else:
        remedy = (
            "Give the env one flat Box of floats, from gymnasium.spaces.flatten_space where all its parts are such, "
            "and translate in its step (gymnasium.spaces.unflatten); discrete parts alone may be numbered, for "
            "ActionShield"
        )
    raise ConfigurationError(f"expected a continuous Box action space of shape (m,), got {space}. {remedy}")
