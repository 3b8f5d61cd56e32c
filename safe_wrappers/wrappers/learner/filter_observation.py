"""FilterObservation: shows the learner what the filter decides by."""

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, whole_number
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import plain_data
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter, filter_inside
from safe_wrappers.wrappers.common.layer import Env, LayerWrapper, Reset, Step

KEY: Final = "filter"
"""Of the features in a Dict observation."""


class FilterObservation(LayerWrapper):
    """Appends to the observation what the filter decides by, so that the filtered task is Markov for the learner.

    The features are bounded in [-1, 1] and have the same shape at every step: of each constraint its
    `BoundConstraint.features` (the smallest h; of obstacles the nearest ones, their direction, clearance and closing
    speed; the side of a detour), then the last correction, in shares of the action box.

    It shows the constraints' truth, for example exact positions where the task's own observation has a lidar. So
    compare with an unfiltered learner that sees the same: without a filter inside, give the constraints.

    A flat observation (a Box of one dimension) becomes longer, a Dict gets the key ``"filter"``, and any other
    becomes a Dict with ``"observation"`` and ``"filter"``.

    Args:
        env: With a `CBFActionFilter` inside, or without one and with `constraints`.
        constraints: What to observe in an env without a filter, as for `CBFActionFilter`; nothing is filtered.
        plant: Likewise.
        neighbours: How many obstacles of each constraint are shown, the nearest.

    Raises:
        ConfigurationError: No filter and no constraints, or both; or a Dict observation that has the key already.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")), neighbours=4)
        >>> env.observation_space.shape  # 60 of the task's own
        (80,)
    """

    layer: ClassVar = Layer.OBSERVATION

    def __init__(
        self,
        env: Env,
        constraints: Sequence[Constraint | dict[str, Any]] | None = None,
        plant: Plant | None = None,
        neighbours: int = 4,
    ) -> None:
        arguments = dict(locals())
        LayerWrapper.__init__(self, env)
        inside = filter_inside(env)
        if inside is None and constraints is None:
            wanted = (
                "FilterObservation(sw.protect(env)), or constraints=[...] to observe them without a filter"
            )
            raise ConfigurationError(f"FilterObservation needs a filter inside or constraints: {wanted}")
        if inside is not None and (constraints is not None or plant is not None):
            raise ConfigurationError(
                "FilterObservation shows what the filter inside decides by; leave constraints and plant out"
            )
        self.neighbours = whole_number("neighbours", neighbours, least=0)
        if constraints is not None:
            observer = CBFActionFilter(env, constraints, plant)
            arguments["constraints"] = [plain_data(c) for c in observer.constraints]
        self._record(arguments, plant=plant)
        self._acts = inside is not None
        self._observer = inside if inside is not None else observer
        low, high = np.ravel(self._observer.action_space.low), np.ravel(self._observer.action_space.high)  # type: ignore[attr-defined]
        self._low, self._high = low.astype(np.float64), high.astype(np.float64)
        count = sum(c.feature_count(self.neighbours) for c in self._observer.filter.bound) + low.size
        self.observation_space = self._space(env.observation_space, count)

    def _space(self, space: spaces.Space[Any], count: int) -> spaces.Space[Any]:
        features = spaces.Box(-1.0, 1.0, (count,), np.float32)
        if isinstance(space, spaces.Dict):
            if KEY in space.spaces:
                raise ConfigurationError(f"the observation has a key {KEY!r} already: {sorted(space.spaces)}")
            return spaces.Dict({**space.spaces, KEY: features})
        if (
            isinstance(space, spaces.Box)
            and len(space.shape) == 1
            and space.dtype in (np.float32, np.float64)
        ):
            ones = np.ones(count)
            low, high = np.concatenate([space.low, -ones]), np.concatenate([space.high, ones])
            return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)
        return spaces.Dict({"observation": space, KEY: features})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env; no correction yet."""
        observation, info = self.env.reset(seed=seed, options=options)
        if not self._acts:
            self._observer.filter.start()
        return self._with_features(observation, np.zeros(self._low.size)), info

    def step(self, action: Any) -> Step:
        """Step the env, and look at the state that it has reached as the filter will."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        if self._acts:
            correction = info[keys.EXECUTED_ACTION] - info[keys.PROPOSED_ACTION]
        else:
            correction = np.zeros(self._low.size)
            given = np.nan_to_num(np.asarray(action, dtype=np.float64))
            self._observer.filter.executed(np.clip(given, self._low, self._high))
        self._observer.filter.observe()
        return self._with_features(observation, correction), reward, terminated, truncated, info

    def _with_features(self, observation: Any, correction: Array) -> Any:
        observed = self._observer.filter
        shares = np.clip(correction / (self._high - self._low), -1.0, 1.0)
        if observed.margin == observed.margin:
            parts = [c.features(self.neighbours) for c in observed.bound]
        else:  # the state is not a number, and nothing was judged
            parts = [np.full(c.feature_count(self.neighbours), np.nan) for c in observed.bound]
        features = np.concatenate([*parts, shares])
        space = self.observation_space
        if isinstance(space, spaces.Box):
            return np.concatenate([observation, features]).astype(space.dtype)
        if isinstance(self.env.observation_space, spaces.Dict):
            return {**observation, KEY: features.astype(np.float32)}
        return {"observation": observation, KEY: features.astype(np.float32)}
