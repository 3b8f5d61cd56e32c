"""A cost for a task that has none, and what filter and task did, per episode: CostFunction, RecordInterventions."""

import math
import pkgutil
from collections.abc import Callable
from typing import Any, ClassVar, Final

import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Step
from safe_wrappers.wrappers.stack import Layer

COLUMNS: Final = ("length", "return", *(figure.name for figure in keys.EPISODE))
"""All that a summary may hold; what neither the task nor the stack reports is missing there."""
_OF_FIGURES: Final = tuple(dict.fromkeys(name for figure in keys.EPISODE for name in figure.of))


Judge = Callable[[Any], float]
"""Takes the unwrapped env, returns the cost of the step that it has just made."""


class CostFunction(LayerWrapper):
    """Writes ``info["cost"]`` for a task that does not judge itself; changes nothing else.

    After every step, and after a reset, `fn` judges the env's state, not what happened within the control step; any
    number above 0 is a violation. Put it next to the task.

    Args:
        env: Whose task reports no cost.
        fn: Takes `env.unwrapped`, which it must not change, returns a finite number (or a bool); or its name,
            "module:function", with which `env.spec` can be written as JSON.

    Info, at every step and after a reset: ``cost`` (float).

    Raises:
        ConfigurationError: `fn` is no function, cannot be imported, or returned something else than a finite number;
            the env has a cost of its own; or a wrong order.

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
        function: Any = fn
        if isinstance(fn, str):
            try:
                # Without a colon a name could also be a module's, which is no function.
                function = pkgutil.resolve_name(fn) if ":" in fn else None
            except (ImportError, AttributeError, ValueError) as error:
                raise ConfigurationError(f"fn: {fn!r} cannot be imported: {error}") from None
        if not callable(function):
            raise ConfigurationError(f"fn is a function of the env or its name 'module:function'; got {fn!r}")
        self.fn: Judge = function

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._judge(info)
        return observation

    def step(self, action: Any) -> Step:
        """Steps the env and judges where it is now."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        self._judge(info)
        return observation, reward, terminated, truncated, info

    def _judge(self, info: dict[str, Any]) -> None:
        refuse_own_cost(self.unwrapped, info)
        cost = np.asarray(given := self.fn(self.unwrapped))
        if cost.shape != () or cost.dtype.kind not in "biuf" or not np.isfinite(cost):
            raise ConfigurationError(
                f"the cost function {self.fn} must return one finite number, got {given!r}"
            )
        info[keys.COST] = float(cost)


def refuse_own_cost(task: Any, info: dict[str, Any]) -> None:
    """A task that judges itself needs no other judge, and two would contradict each other."""
    for key in (keys.COST, keys.COST_SUBSTEP):
        if key in info:
            raise ConfigurationError(f"{task} reports a cost of its own (info[{key!r}]); use one of them")


class RecordInterventions(LayerWrapper):
    """Counts interventions, corrections and costs; changes neither actions, rewards nor observations.

    Put it outside the layers that it counts, and inside `ChunkHandover` and SB3's `Monitor`. At an episode's last
    step `info` gains `info["interventions"]`, a dict: `length`, `return` (of the task: penalties that a wrapper
    inside has taken off are added back), and the figures of `safe_wrappers.info.EPISODE`. What nobody reported is not
    zero: it is missing in the summary. The same holds for a 0 that was not reported at every step; a count above 0 is
    a lower bound.

    Args:
        env: The env to record.

    Raises:
        ConfigurationError: A `ChunkHandover` or `ActionRepeat` inside.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.RecordInterventions(gym.make("Pendulum-v1", max_episode_steps=3))
        >>> _ = env.reset(seed=0)
        >>> for _ in range(3):
        ...     _, _, _, _, info = env.step(env.action_space.low)
        >>> print(list(info["interventions"]))  # no filter, and a task without a cost
        ['length', 'return']
    """

    layer: ClassVar = Layer.RECORDER

    @property
    def filter_time_us(self) -> float | None:
        """Mean time of one filter call, microseconds; None with no filter inside or before its first call."""
        if not self.env.has_wrapper_attr("filter_seconds"):
            return None
        calls = int(self.env.get_wrapper_attr("filter_calls"))
        return 1e6 * float(self.env.get_wrapper_attr("filter_seconds")) / calls if calls else None

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._return = 0.0
        self._steps: list[dict[str, Any]] = []
        return observation

    def step(self, action: Any) -> Step:
        """Step the env; its info gains the summary at the episode's end."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        penalties = info.get(keys.OCCLUSION_PENALTY, 0.0) + info.get(keys.ADAPTION_PENALTY, 0.0)
        self._return += float(reward) + float(penalties)
        self._steps.append(_told(info))
        if terminated or truncated:
            figures = {one.name: _figure(one, self._steps) for one in keys.EPISODE}
            summary = {"length": len(self._steps), "return": self._return}
            summary |= {name: value for name, value in figures.items() if value is not None}
            info[keys.EPISODE_SUMMARY] = summary
        return observation, reward, terminated, truncated, info


def _told(info: dict[str, Any]) -> dict[str, Any]:
    """What a step has said of the figures, copied: an env may use its arrays again."""
    return {name: np.array(info[name]) for name in _OF_FIGURES if name in info}


def _figure(figure: keys.EpisodeFigure, steps: list[dict[str, Any]]) -> int | float | None:
    """A figure of an episode; None if nobody reported it, or for a 0 that is not of every step. NaN is no report."""
    how, of = figure.how, [keys.KEYS[name] for name in figure.of]
    numbers: list[Any] = []
    for step in steps:
        told = [n for key in of if key.name in step and (n := key.number(step[key.name])) == n]
        if told:
            above_zero = how == "count" and of[0].dtype != "int64"
            numbers.append(max(told) > 0.0 if above_zero else told[0])
    if how == "min":
        return min(filter(math.isfinite, numbers), default=None)
    if how == "last":
        return int(numbers[-1]) if numbers else None
    if how == "any":
        return bool(max(numbers)) if numbers else None
    if how == "p95":
        return float(np.percentile(numbers, 95)) if len(numbers) == len(steps) else None
    total = sum(numbers) if how in ("sum", "mean") else int(sum(numbers))
    if not total and len(numbers) < len(steps):
        return None
    return total / len(steps) if how == "mean" else total
