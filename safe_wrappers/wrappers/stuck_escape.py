"""StuckEscape: where policy and filter block each other, another action is proposed for a while."""

from collections import deque
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, non_negative, positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Reset, Step, WrapperRng, action_array


class StuckEscape(LayerWrapper):
    """Proposes another action for a while, in the policy's place, where policy and filter are stuck.

    Stuck means: in the last `after_s` more than half of the policy's actions were changed by the filter or replaced
    by this wrapper, and the rewards of these steps add up to `progress` at most. A deterministic policy that pushes
    against the filter, or circles an obstacle, may do so for ever. For `escape_s` an action that was drawn at random
    is proposed. The filter inside checks it like any other, so that its guarantees stay. A deadlock is ended by
    chance, not by a plan; it may take several draws.

    While it acts, the filter's keys are about what the filter was given, the drawn action: an escape is
    `cbf/escaping`, not `cbf/intervened`. `cbf/nonfinite` is also true for a policy's action that is not finite.

    Args:
        env: With a `CBFActionFilter` inside.
        after_s: The time without progress, s.
        progress: The sum of rewards, in the task's units, up to which there is none.
        escape_s: For how long another action is proposed, s; 0 reports alone.

    Info, at every step: ``cbf/stuck``, ``cbf/escaping`` (bool).

    Raises:
        ConfigurationError: No filter inside, or times that are not.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.StuckEscape(sw.protect(gym.make("SafePointGoal1-v0")), after_s=2.0, progress=0.1)
        >>> _ = env.reset(seed=0)
        >>> env.step(env.action_space.sample())[4]["cbf/stuck"]
        False
    """

    layer: ClassVar = Layer.ESCAPE

    _drawn: Array

    def __init__(
        self,
        env: Env,
        after_s: float = 2.0,
        progress: float = 0.0,
        escape_s: float = 1.0,
    ) -> None:
        arguments = dict(locals())
        LayerWrapper.__init__(self, env)
        inside = filter_inside(env)
        if inside is None:
            raise ConfigurationError(
                "StuckEscape needs a CBFActionFilter inside: StuckEscape(sw.protect(env))"
            )
        if not (isinstance(progress, int | float | np.number) and np.isfinite(progress)):
            raise ConfigurationError(f"progress is a finite sum of rewards, got {progress!r}")
        control_dt = inside.plant.control_dt
        self._window = max(1, round(positive("after_s", after_s, "s") / control_dt))
        self._escape = round(non_negative("escape_s", escape_s, "s") / control_dt)
        self._inside = inside
        self._record(arguments)
        self.progress = float(progress)
        self._rng = WrapperRng("StuckEscape")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env; nothing is stuck yet."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._rng.reset(self.env, seed)
        self._rewards: deque[float] = deque(maxlen=self._window)
        self._changed: deque[bool] = deque(maxlen=self._window)
        self._left = 0
        return observation, info | {keys.CBF_STUCK: False, keys.CBF_ESCAPING: False}

    def step(self, action: Any) -> Step:
        """Step the env with the policy's action, or with the drawn one."""
        escaping = self._left > 0
        sent = action
        if escaping:
            own = action_array(action, self._drawn.shape, np.float64)
            sent = self._drawn
        observation, reward, terminated, truncated, info = self.env.step(sent)
        if escaping:
            self._left -= 1
            info[keys.CBF_NONFINITE] |= not np.isfinite(own).all()
        self._rewards.append(float(reward))
        self._changed.append(info[keys.CBF_INTERVENED] or escaping)
        full = len(self._rewards) == self._window
        stuck = full and 2 * sum(self._changed) > self._window and sum(self._rewards) <= self.progress
        if stuck and self._escape and self._left == 0 and not escaping:
            self._drawn = self._draw()
            self._left = self._escape
        info[keys.CBF_STUCK], info[keys.CBF_ESCAPING] = stuck, escaping
        return observation, reward, terminated, truncated, info

    def _draw(self) -> Array:
        """An action between the plant's bounds, evenly distributed, as the action space has it."""
        plant, space = self._inside.plant, self._inside.action_space
        assert isinstance(space, Box)  # the filter takes no other
        low, high = np.maximum(plant.lower, space.low), np.minimum(plant.upper, space.high)
        drawn: Array = self._rng.draw.uniform(low, high).astype(space.dtype)
        return drawn
