"""SafeActionMap: the policy's box is mapped onto the actions that the filter admits."""

from collections.abc import Callable, Iterator
from typing import Any, ClassVar, Final

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, finite_array
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.fallback import brake
from safe_wrappers.filter.ray_map import Ray, centre, mapped_on_ray, rounded
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.common.layer import Env, LayerWrapper, Reset, Step
from safe_wrappers.wrappers.common.receiver import action_array

AnchorFunction = Callable[[Any], ArrayLike | None]
"""Takes the env inside of the map, which it must not change; returns an action, shape (m,), or None for no anchor."""

ANCHORS: Final = ("centre", "backup", "closest")


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

    **What it asks** is what the filter asks, mostly up to 14 times in a step, for "centre" up to 13 times more for
    each component, which is dear where constraints forecast.

    Args:
        env: With a `CBFActionFilter` inside, and a bounded action space.
        anchor: "backup": the first backup control of a constraint, or braking, that every constraint admits.
            "centre": from there halfway between the ends of what is admitted, component by component. "closest": what
            the filter would execute; actions that are admitted stay as they are, and the others differ only where
            that answer is not on the edge of what is admitted, as on a detour. Or a function of the env.

    Info, at every step: ``map/scale`` (float), by what the distance was multiplied, 1 is an unchanged action;
    ``map/anchor`` (bool), False where there was no admitted anchor, or no finite action: then the action goes to the
    filter as it is. ``proposed_action`` is the mapped one, since the filter was given it.

    Raises:
        ConfigurationError: No filter inside; an action space without bounds, or a wrapper in between that changes
            actions; no backup control to begin from; at a step, a function that returned no action.
        UnknownNameError: No anchor of that name.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.SafeActionMap(sw.protect(gym.make("SafePointGoal1-v0")))
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> info["map/scale"], info["cbf/intervened"]
        (1.0, False)
    """

    layer: ClassVar = Layer.MAP

    def __init__(self, env: Env, anchor: str | AnchorFunction = "centre") -> None:
        LayerWrapper.__init__(self, env)
        self._filter = _filter_inside(env)
        space: Any = env.action_space
        if not space.is_bounded():
            raise ConfigurationError(f"SafeActionMap maps a box with finite bounds, got {space}")
        if not callable(anchor) and anchor not in ANCHORS:
            names = ", ".join(ANCHORS)
            raise UnknownNameError(f"no anchor {anchor!r}; choose {names}, or pass a function of the env")
        engine = self._filter.filter
        if anchor in ("centre", "backup") and not (
            engine.plant.can_brake or any(c.has_backup for c in engine.bound)
        ):
            raise ConfigurationError(
                f"anchor {anchor!r}: no constraint of this filter knows a backup control, and the plant does not"
                " brake; use 'closest', or a function of the env"
            )
        self._record({"anchor": anchor})
        self.anchor = anchor
        self._low, self._high = np.asarray(space.low, np.float64), np.asarray(space.high, np.float64)
        self._shape, self._dtype = space.shape, space.dtype

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Resets the env; info has the keys of a step that maps nothing."""
        observation, info = self.env.reset(seed=seed, options=options)
        info[keys.MAP_SCALE], info[keys.MAP_ANCHOR] = 1.0, False
        return observation, info

    def step(self, action: Any) -> Step:
        """Steps the env with the mapped action."""
        sent, scale, anchored = self.mapped(action)
        observation, reward, terminated, truncated, info = self.env.step(sent)
        info[keys.MAP_SCALE], info[keys.MAP_ANCHOR] = scale, anchored
        return observation, reward, terminated, truncated, info

    def mapped(self, action: Any) -> tuple[Any, float, bool]:
        """What is sent to the filter in the env's present state, and the two info keys.

        The env must be stepped next.
        """
        given: Array = action_array(action, self._shape, np.float64)
        engine = self._filter.filter
        self._filter.observe()
        if engine.margin != engine.margin or not np.isfinite(given).all():
            return action, 1.0, False
        boxed = rounded(given, self._low, self._high, self._dtype)
        low, high = self._acting()
        force = np.clip(boxed, low, high)
        anchor = self._anchor(boxed, low, high)
        if anchor is None:
            return action, 1.0, False
        if (np.abs(anchor - force) <= 1e-9 * (high - low)).all():
            return action, 1.0, True
        control, scale = mapped_on_ray(engine.admits, Ray(anchor, force, low, high, self._dtype), boxed)
        return (action if control is boxed else control.astype(self._dtype)), scale, True

    def _acting(self) -> tuple[Array, Array]:
        """The box of actions between which the force still changes: beyond it a ray would lead nowhere."""
        plant = self._filter.filter.plant
        low, high = np.clip(plant.acting_range or (plant.lower, plant.upper), self._low, self._high)
        return low, high

    def _anchor(self, boxed: Array, low: Array, high: Array) -> Array | None:
        """The first known action that is admitted, as it can be executed, or the centre from there."""
        admits = self._filter.filter.admits
        for known in self._known(boxed):
            control = rounded(known, low, high, self._dtype)
            if admits(control):
                if self.anchor == "centre":
                    return centre(admits, control, low, high, self._dtype)
                return control
        return None

    def _known(self, boxed: Array) -> Iterator[Array]:
        engine = self._filter.filter
        if callable(self.anchor):
            given = self.anchor(self.env)
            if given is not None:
                yield self._checked(given)
        elif self.anchor == "closest":
            yield engine.filter(boxed).control
        else:
            yield from (control for c in engine.bound if (control := c.backup()) is not None)
            if engine.plant.can_brake:
                yield brake(engine.plant)

    def _checked(self, given: ArrayLike) -> Array:
        control = finite_array("the anchor", given)
        if control.shape != self._shape:
            raise ConfigurationError(
                f"the anchor's function must return an action of shape {self._shape}, or None; got {given!r}"
            )
        return control


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
