"""For policies behind a filter: what they see and are paid for, how often they decide, and where it is stuck."""

from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces

from safe_wrappers import info as keys
from safe_wrappers.errors import Array, ConfigurationError, positive, whole_number
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter, filter_inside
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Step
from safe_wrappers.wrappers.stack import Layer


class ActionRepeat(LayerWrapper):
    """Executes an action for several control steps, each of which the filter inside checks anew.

    Rewards are summed up, and the info keys of this library merged over the control steps (`safe_wrappers.info`).
    Exploration noise that lasts moves a robot farther than noise that averages out at 50 control steps per second.

    Args:
        env: A filter, recorders and penalties, which count control steps, belong inside.
        repeat: Control steps per action; fewer where the episode ends.

    Raises:
        ConfigurationError: `repeat` is not a whole number of at least 1, or the env's steps are chunks already.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.ActionRepeat(sw.protect(gym.make("SafePointGoal1-v0")), repeat=4)
        >>> _ = env.reset(seed=0)
        >>> _, reward, _, _, info = env.step(env.action_space.sample())
    """

    layer: ClassVar = Layer.HANDOVER

    def __init__(self, env: Env, repeat: int) -> None:
        LayerWrapper.__init__(self, env)
        self.repeat = whole_number("repeat", repeat, least=1)

    def step(self, action: Any) -> Step:
        """Step the env with the same action until `repeat` control steps are made or the episode ends."""
        return self._make_steps(self.repeat, lambda: self._pass_on(action))


class AdaptionPenalty(LayerWrapper):
    """Takes a penalty off the reward at every step at which the filter changed the action.

    The learner keeps its own action a, and its reward is r(s, a_safe) less `penalty` (Krasowski et al., Provably Safe
    Reinforcement Learning, TMLR 2023).
    An action that is not finite is changed, and costs no more than any other.

    Wrappers that scale or clip rewards belong inside. Not for hindsight replay, which asks the task for rewards anew.

    Args:
        env: With a `CBFActionFilter` inside.
        penalty: For every changed step, in units of the task's reward, above 0.

    Info, at every step: ``adaption/penalty`` (float); with it added back, the reward is the task's own.

    Raises:
        ConfigurationError: No filter inside, a second AdaptionPenalty, or a penalty that is not above 0.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(limit=4.0)])
        >>> env = sw.AdaptionPenalty(env, penalty=0.1)
        >>> _ = env.reset(seed=0)
        >>> _ = env.step(env.action_space.high)
        >>> info = env.step(env.action_space.high)[4]  # beyond 4 rad/s
        >>> bool(info["cbf/intervened"]), info["adaption/penalty"]
        (True, 0.1)
    """

    layer: ClassVar = Layer.ADAPTION

    def __init__(self, env: Env, penalty: float) -> None:
        LayerWrapper.__init__(self, env)
        needed_filter(env, "AdaptionPenalty(sw.protect(env), penalty=...)")
        self.penalty = positive("penalty", penalty, "the task's reward")

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        info[keys.ADAPTION_PENALTY] = 0.0
        return observation

    def step(self, action: Any) -> Step:
        """Steps the env; an unchanged step's reward passes through untouched."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        changed = info[keys.CBF_INTERVENED]
        if changed:
            reward = float(reward) - self.penalty
        info[keys.ADAPTION_PENALTY] = self.penalty if changed else 0.0
        return observation, reward, terminated, truncated, info


class StuckMonitor(LayerWrapper):
    """Reports where policy and filter block each other. Changes nothing.

    Stuck means: in the last `after_s` the filter changed more than half of the actions, and the rewards of these
    steps add up to `progress` at most.

    Args:
        env: With a `CBFActionFilter` inside.
        after_s: The time without progress, s.
        progress: The sum of rewards, in the task's units, up to which there is none.

    Info, at every step: ``cbf/stuck`` (bool).

    Raises:
        ConfigurationError: No filter inside, `after_s` is not above 0, or `progress` is not finite.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.StuckMonitor(sw.protect(gym.make("SafePointGoal1-v0")), after_s=2.0, progress=0.1)
        >>> _ = env.reset(seed=0)
        >>> env.step(env.action_space.sample())[4]["cbf/stuck"]
        False
    """

    layer: ClassVar = Layer.STUCK

    def __init__(self, env: Env, after_s: float = 2.0, progress: float = 0.0) -> None:
        LayerWrapper.__init__(self, env)
        inside = needed_filter(env, "StuckMonitor(sw.protect(env))")
        if not (isinstance(progress, int | float | np.number) and np.isfinite(progress)):
            raise ConfigurationError(f"progress is a finite sum of rewards, got {progress!r}")
        self._window = max(1, round(positive("after_s", after_s, "s") / inside.plant.control_dt))
        self.progress = float(progress)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._rewards: deque[float] = deque(maxlen=self._window)
        self._changed: deque[bool] = deque(maxlen=self._window)
        info[keys.CBF_STUCK] = False
        return observation

    def step(self, action: Any) -> Step:
        """Step the env, and look at the last `after_s`."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        self._rewards.append(float(reward))
        self._changed.append(info[keys.CBF_INTERVENED])
        full = len(self._rewards) == self._window
        many = 2 * sum(self._changed) > self._window
        info[keys.CBF_STUCK] = full and many and sum(self._rewards) <= self.progress
        return observation, reward, terminated, truncated, info


KEY: Final = "filter"
"""Of the features in a Dict observation."""


class FilterObservation(LayerWrapper):
    """Appends to the observation what the filter decides by, so that the filtered task is Markov for the learner.

    The features are bounded in [-1, 1] and have the same shape at every step: of each constraint its `features` (the
    smallest h; of obstacles the nearest ones, their direction, clearance and closing speed; the side of a detour),
    then the last correction, in shares of the action box.

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
        LayerWrapper.__init__(self, env)
        inside = filter_inside(env)
        if (inside is None) == (constraints is None) or (inside is not None and plant is not None):
            raise ConfigurationError(
                "FilterObservation(sw.protect(env)) shows what the filter inside decides by; without one give it "
                "constraints=[...], which then observe alone"
            )
        self.neighbours = whole_number("neighbours", neighbours, least=0)
        self._acts = inside is not None
        self._observer = CBFActionFilter(env, constraints or (), plant) if inside is None else inside
        space: Any = self._observer.action_space
        self._low, self._high = (np.ravel(end).astype(np.float64) for end in (space.low, space.high))
        self._counts = [c.feature_count(self.neighbours) for c in self._observer.filter.bound]
        count = sum(self._counts) + self._low.size
        self._widen_observation(KEY, spaces.Box(-1.0, 1.0, (count,), np.float32))

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        if not self._acts:
            self._observer.plant.received(observation, info)
            self._observer.filter.start()
        return self._with_features(observation, np.zeros(self._low.size))

    def step(self, action: Any) -> Step:
        """Step the env, and look at the state that it has reached as the filter will."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        if self._acts:
            correction = info[keys.EXECUTED_ACTION] - info[keys.PROPOSED_ACTION]
        else:
            correction = np.zeros(self._low.size)
            given = np.nan_to_num(np.asarray(action, dtype=np.float64))
            self._observer.filter.executed(np.clip(given, self._low, self._high))
            self._observer.plant.received(observation, info)
        self._observer.look()
        return self._with_features(observation, correction), reward, terminated, truncated, info

    def _with_features(self, observation: Any, correction: Array) -> Any:
        observed = self._observer.filter
        shares = np.clip(correction / (self._high - self._low), -1.0, 1.0)
        if observed.margin == observed.margin:
            parts = [c.features(self.neighbours) for c in observed.bound]
        else:  # the state is not a number, and nothing was judged
            parts = [np.full(count, np.nan) for count in self._counts]
        return self._with_numbers(observation, KEY, np.concatenate([*parts, shares]))


def needed_filter(env: Env, example: str) -> CBFActionFilter:
    """The filter inside, or an error that shows how to have one."""
    inside = filter_inside(env)
    if inside is None:
        raise ConfigurationError(f"{example.partition('(')[0]} needs a CBFActionFilter inside: {example}")
    return inside
