"""SafeActionMap and StuckEscape: they give the filter another action than the policy's."""

from collections import deque
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, non_negative, positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.fallback import brake
from safe_wrappers.filter.ray_map import Ray, centre, mapped_on_ray, rounded
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter, filter_inside
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Reset, Step, WrapperRng, action_array


class SafeActionMap(LayerWrapper):
    """Moves the policy's action along a ray from an anchor, so that the whole box is mapped onto safe actions.

    The anchor is an action that is admitted. On the ray from it through the policy's action, distances are multiplied
    by (admitted part of the ray) / (ray to the edge of the box): the ray mask of Stolz et al., Excluding the
    Irrelevant, NeurIPS 2024. So actions that differ on a ray are executed as actions that differ, in the same order,
    where a filter alone executes the same for all that it refuses. Where the whole ray is admitted the action passes
    bit for bit. The filter inside decides as ever, and has the last word.

    **It is part of the policy's interface**: a policy that was trained in it needs it wherever the filter is on.

    **It assumes** that what is admitted on a ray is one stretch that begins at the anchor. Where it is not, the first
    stretch is used, if its end shows at a quarter, a half, three quarters or the end of the ray; the mapped action
    itself is always asked about. The edge is found to a thousandth of the ray. The box ends where the actuators
    saturate: beyond, actions differ in nothing.

    **What it asks** is what the filter asks, mostly up to 14 times in a step, and up to 13 times more for each
    component, which is dear where constraints forecast.

    The anchor is the first backup control of a constraint, or braking, that every constraint admits, moved halfway
    between the ends of what is admitted, component by component.

    Args:
        env: With a `CBFActionFilter` inside, and a bounded action space.

    Info, at every step: ``map/scale`` (float), by what the distance was multiplied, 1 is an unchanged action; NaN
    where there was no admitted anchor, or no finite action: then the action goes to the filter as it is.
    ``proposed_action`` is the mapped one, since the filter was given it.

    Raises:
        ConfigurationError: No filter inside; an action space without bounds, or a wrapper in between that changes
            actions; no backup control to begin from.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.SafeActionMap(sw.protect(gym.make("SafePointGoal1-v0")))
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> info["map/scale"], info["cbf/intervened"]
        (1.0, False)
    """

    layer: ClassVar = Layer.MAP

    def __init__(self, env: Env) -> None:
        LayerWrapper.__init__(self, env)
        self._filter = _filter_inside(env)
        space: Any = env.action_space
        if not space.is_bounded():
            raise ConfigurationError(f"SafeActionMap maps a box with finite bounds, got {space}")
        engine = self._filter.filter
        if not (engine.plant.can_brake or any(c.has_backup for c in engine.bound)):
            raise ConfigurationError(
                "SafeActionMap needs an anchor: no constraint of this filter knows a backup control, and the plant"
                " does not brake"
            )
        self._record({})
        self._low, self._high = np.asarray(space.low, np.float64), np.asarray(space.high, np.float64)
        self._shape, self._dtype = space.shape, space.dtype

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Resets the env; info has the key of a step that maps nothing."""
        observation, info = self.env.reset(seed=seed, options=options)
        info[keys.MAP_SCALE] = 1.0
        return observation, info

    def step(self, action: Any) -> Step:
        """Steps the env with the mapped action."""
        sent, scale = self.mapped(action)
        observation, reward, terminated, truncated, info = self.env.step(sent)
        info[keys.MAP_SCALE] = scale
        return observation, reward, terminated, truncated, info

    def mapped(self, action: Any) -> tuple[Any, float]:
        """What is sent to the filter in the env's present state, and `map/scale`.

        The env must be stepped next.
        """
        given: Array = action_array(action, self._shape, np.float64)
        engine = self._filter.filter
        self._filter.observe()
        if engine.margin != engine.margin or not np.isfinite(given).all():
            return action, keys.NOT_JUDGED
        boxed = rounded(given, self._low, self._high, self._dtype)
        low, high = self._acting()
        force = np.clip(boxed, low, high)
        anchor = self._anchor(low, high)
        if anchor is None:
            return action, keys.NOT_JUDGED
        if (np.abs(anchor - force) <= 1e-9 * (high - low)).all():
            return action, 1.0
        control, scale = mapped_on_ray(engine.admits, Ray(anchor, force, low, high, self._dtype), boxed)
        return (action if control is boxed else control.astype(self._dtype)), scale

    def _acting(self) -> tuple[Array, Array]:
        """The box of actions between which the force still changes: beyond it a ray would lead nowhere."""
        plant = self._filter.filter.plant
        low, high = np.clip(plant.acting_range or (plant.lower, plant.upper), self._low, self._high)
        return low, high

    def _anchor(self, low: Array, high: Array) -> Array | None:
        """The centre of what is admitted around the first known action that is."""
        engine = self._filter.filter
        known = [control for c in engine.bound if (control := c.backup()) is not None]
        if engine.plant.can_brake:
            known.append(brake(engine.plant))
        for one in known:
            control = rounded(one, low, high, self._dtype)
            if engine.admits(control):
                return centre(engine.admits, control, low, high, self._dtype)
        return None


def _filter_inside(env: Env) -> CBFActionFilter:
    """The filter; an error where there is none, or where something in between changes actions."""
    for inner in wrappers_of(env):
        if isinstance(inner, CBFActionFilter):
            return inner
        if isinstance(inner, gym.ActionWrapper):
            name = type(inner).__name__
            raise ConfigurationError(
                f"{name} inside SafeActionMap: it would change actions that were mapped onto admitted ones; put it"
                f" outside: {name}(SafeActionMap(env, ...), ...)"
            )
    raise ConfigurationError("SafeActionMap needs a CBFActionFilter inside: SafeActionMap(sw.protect(env))")


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
