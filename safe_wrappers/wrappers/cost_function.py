"""CostFunction: a cost for a task that has none of its own, judged on the env's true state after each step."""

import pkgutil
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Reset, Step

Judge = Callable[[Any], float]
"""Takes the unwrapped env, returns the cost of the step that it has just made."""


class CostFunction(LayerWrapper):
    """Writes ``info["cost"]`` for a task that does not judge itself; changes nothing else.

    After every step, and after a reset, `fn` judges the state in which the env now is, not what happened within the
    control step; any number above 0 is a violation. Put it next to the task.

    Args:
        env: Whose task reports no cost.
        fn: Takes `env.unwrapped`, which it must not change, returns a finite number (or a bool); or its name,
            "module:function". One that cannot be imported makes `env.spec.to_json()` fail.

    Info, at every step and after a reset: ``cost`` (float).

    Raises:
        ConfigurationError: `fn` is no function, cannot be imported, or returned something else than a finite
            number; the env has a cost of its own; or a wrong order.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> def too_fast(env):
        ...     return abs(env.data.qvel[0]) > 0.5
        >>> env = sw.CostFunction(gym.make("HalfCheetah-v5"), too_fast)
        >>> _ = env.reset(seed=0)
        >>> costs = [env.step(env.action_space.high)[4]["cost"] for _ in range(20)]
        >>> sorted(set(costs))
        [0.0, 1.0]
    """

    layer: ClassVar = Layer.COST

    def __init__(self, env: Env, fn: Judge | str) -> None:
        LayerWrapper.__init__(self, env)
        function = _imported(fn) if isinstance(fn, str) else fn
        if not callable(function):
            raise ConfigurationError(f"fn is a function of the env or its name 'module:function'; got {fn!r}")
        self._record({"fn": _reference(function)})
        self.fn: Judge = function

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Resets the env; info has the cost of the state in which the episode starts."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._judge(info)
        return observation, info

    def step(self, action: Any) -> Step:
        """Steps the env and judges where it is now."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        self._judge(info)
        return observation, reward, terminated, truncated, info

    def _judge(self, info: dict[str, Any]) -> None:
        refuse_own_cost(self.unwrapped, info)
        given = self.fn(self.unwrapped)
        cost = np.asarray(given)
        if cost.shape != () or cost.dtype.kind not in "biuf" or not np.isfinite(cost):
            name = getattr(self.fn, "__name__", repr(self.fn))
            raise ConfigurationError(f"the cost function {name} must return one finite number, got {given!r}")
        info[keys.COST] = float(cost)


def refuse_own_cost(task: Any, info: dict[str, Any]) -> None:
    """A task that judges itself needs no other judge, and two would contradict each other."""
    for key in (keys.COST, keys.COST_SUBSTEP):
        if key in info:
            raise ConfigurationError(f"{task} reports a cost of its own (info[{key!r}]); use one of them")


def _imported(name: str) -> Any:
    try:
        # Without a colon a name could also be a module's, which is no function.
        return pkgutil.resolve_name(name) if ":" in name else None
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigurationError(f"fn: {name!r} ('module:function') cannot be imported: {error}") from None


def _reference(function: Any) -> Any:
    """The name by which another process can import the function; the function itself where there is none."""
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", None)
    if module in (None, "__main__") or name is None:
        return function
    reference = f"{module}:{name}"
    try:
        return reference if pkgutil.resolve_name(reference) is function else function
    except (ImportError, AttributeError, ValueError):
        return function
