"""ActionMap: what an env makes of an action before it is the model's control, where that is affine.

An env may count its actions in other units than its model's controls: the hands of gymnasium-robotics take actions in
[-1, 1] and put them onto the actuators' ranges. The map is found by stepping a copy of the env, and tried there.
"""

import copy
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.copies import EnvCopier
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.mujoco.binding import Accessed
from safe_wrappers.plants.mujoco.forecast import RESETS, Recorder
from safe_wrappers.plants.mujoco.model import control_range

_TRIALS: Final = 100
_FEWEST: Final = 10  # of them that must not have diverged
_ROUNDING: Final = 1e-6
"""Of controls, as a share of the largest one seen, and of states: envs may compute in single precision."""
_INSTEAD: Final = (
    "Simulate the env itself: PredictiveShield with SimulatorPlant(); or use AnalyticPlant(f=..., g=..., state=...) "
    "with your own f and g."
)


class ActionMap:
    """`control = offset + scale * action`, elementwise.

    Attributes:
        offset: The model's control at the action zero, shape (nu,).
        scale: Change of the control per unit of action, shape (nu,).
        low: Smallest action, shape (nu,).
        high: Largest action, shape (nu,).
    """

    def __init__(self, offset: Array, scale: Array, low: Array, high: Array) -> None:
        self.offset, self.scale, self.low, self.high = offset, scale, low, high

    @property
    def is_identity(self) -> bool:
        """Whether an action is the control."""
        return not self.offset.any() and bool((self.scale == 1.0).all())

    def control(self, action: Array) -> Array:
        """The model's control, shape (nu,)."""
        return self.offset + self.scale * action

    def action(self, control: Array) -> Array:
        """The action for a control, shape (nu,); the one nearest to zero where actions do nothing."""
        acts = self.scale != 0.0
        found = (control - self.offset) / np.where(acts, self.scale, 1.0)
        return np.where(acts, np.clip(found, self.low, self.high), np.clip(0.0, self.low, self.high))

    def reach(self) -> tuple[Array, Array]:
        """The least and the largest control that actions have, shapes (nu,)."""
        # Zero where the scale is, though the end may be infinite.
        ends = [self.scale * np.where(self.scale == 0.0, 0.0, end) for end in (self.low, self.high)]
        return self.offset + np.minimum(*ends), self.offset + np.maximum(*ends)

    def exceeds(self, lower: Array, upper: Array) -> bool:
        """Whether some action has a control outside of this range, shapes (nu,), by more than rounding."""
        least, most = self.reach()
        slack = _ROUNDING * np.abs(self.scale)
        return bool((least < lower - slack).any() or (most > upper + slack).any())

    def actions_between(self, least: Array, most: Array) -> tuple[Array, Array]:
        """The actions whose controls are between these, within the action space; shapes (nu,)."""
        acts = self.scale != 0.0
        ends = [(end - self.offset) / np.where(acts, self.scale, 1.0) for end in (least, most)]
        first, last = np.minimum(*ends), np.maximum(*ends)
        first, last = (np.clip(end, self.low, self.high) for end in (first, last))
        return np.where(acts, first, self.low), np.where(acts, last, self.high)

    def per_action(self, drift: Array, effect: Array) -> tuple[Array, Array]:
        """`drift + effect @ control`, shapes (nv,) and (nv, nu), as the same of actions."""
        return drift + effect @ self.offset, effect * self.scale


def refuse_mapped(action_map: ActionMap | None, asker: str) -> None:
    """Refuse what reads controls off the model itself, named by `asker`, where an action is not the control."""
    if action_map is not None:
        raise UnsupportedEnvError(
            f"{asker} needs actions that are the model's controls; this env makes its controls of them by control = "
            "offset + scale * action. Constraints that forecast take that into account (SpeedLimit, JointSpeedLimit, "
            "JointPositionLimit, Workspace), as do Clearance, Barrier and ImpactSpeedLimit"
        )


class MappedRecorder(Recorder):
    """Forecasts of actions that the env maps to controls; the arguments are those of `Recorder`, and the map."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, substeps: int, action_map: ActionMap
    ) -> None:
        super().__init__(model, data, substeps)
        self._map = action_map
        # Brakes are as strong as actions can make them.
        self._low, self._high = (np.clip(end, *control_range(model)) for end in action_map.reach())

    def act(self, data: mujoco.MjData, control: Array) -> None:
        """Give the machine an action, shape (nu,), as its env does at the start of a control interval."""
        data.ctrl[:] = self._map.control(control)

    def braking(self, data: mujoco.MjData) -> Array:
        """The action that brakes, shape (nu,)."""
        return self._map.action(super().braking(data))


def find_action_map(env: gym.Env[Any, Any], source: Any, ranges_agree: bool) -> ActionMap:
    """The map by which an env makes controls of actions, found on a copy of it.

    Args:
        env: Its action space has one action per control. It and its random generator stay as they are.
        source: Has the unwrapped env's `.model` and `.data`.
        ranges_agree: The action space is the control range, as far as there is one: then actions are controls where
            no copy can be stepped.

    Raises:
        UnsupportedEnvError: No copy can be stepped, or the env does something else with its actions.
    """
    space, name = env.action_space, name_of(env)
    assert isinstance(space, gym.spaces.Box)  # the filter has refused every other space
    box = space.low.astype(np.float64), space.high.astype(np.float64)
    try:
        actions, controls = _tried(env.unwrapped, source, space)
    except Exception as error:
        if ranges_agree:
            return ActionMap(np.zeros(box[0].size), np.ones(box[0].size), *box)
        raise UnsupportedEnvError(
            f"{name} rescales or limits actions in its own step, and no copy of it can be stepped to find out how "
            f"({type(error).__name__}: {error}). {_INSTEAD}"
        ) from error
    guesses = [_ends_to_ends(source.model, box), _through_two(actions, controls, box)]
    errors = [np.abs(controls - g.control(actions)) for g in guesses]
    best = int(np.argmin([np.nan_to_num(error, nan=np.inf).max() for error in errors]))
    worst, allowed = errors[best].max(axis=0), _ROUNDING * np.abs(controls).max(axis=0)
    if not (worst <= allowed).all():
        i = int(np.nanargmax(worst - allowed))
        seen = controls[:, i]
        says = (
            f"in {_TRIALS} steps of random actions its controls were up to {worst[i]:.3g} away from that, at "
            f"actuator {source.model.actuator(i).name or i!r}, which had {seen.min():.3g} to {seen.max():.3g}"
        )
        raise UnsupportedEnvError(
            f"{name} rescales or limits actions in its own step, and not by control = offset + scale * action: "
            f"{says}. The map may depend on its state. {_INSTEAD}"
        )
    return guesses[best]


def _ends_to_ends(model: mujoco.MjModel, box: tuple[Array, Array]) -> ActionMap:
    """The usual map: the middle and the ends of the action space to those of the control range."""
    low, high = model.actuator_ctrlrange.T
    with np.errstate(all="ignore"):
        scale = (high - low) / (box[1] - box[0])
        offset = (low + high) / 2.0 - scale * ((box[0] + box[1]) / 2.0)
    known = np.isfinite(scale) & np.isfinite(offset)
    return ActionMap(np.where(known, offset, 0.0), np.where(known, scale, 1.0), *box)


def _through_two(actions: Array, controls: Array, box: tuple[Array, Array]) -> ActionMap:
    """The map through the first two actions that were tried; see `_tried`."""
    (first, second, *_), (at_first, at_second, *_) = actions, controls
    with np.errstate(all="ignore"):
        scale = np.nan_to_num((at_second - at_first) / (second - first), posinf=0.0, neginf=0.0)
    return ActionMap(np.nan_to_num(at_first - scale * first), scale, *box)


def _tried(raw: Any, source: Any, space: gym.spaces.Box) -> tuple[Array, Array]:
    """Step a copy of an unwrapped env: by the middle of its actions, their upper end, and random ones.

    Returns the actions, and the controls that the env has left in its data, shapes (k, nu).
    """
    twin: Any = EnvCopier(raw).copy()
    at = source.on(twin) if isinstance(source, Accessed) else twin
    space = copy.deepcopy(space)
    space.seed(0)
    low = np.where(np.isfinite(space.low), space.low, -1.0)
    high = np.where(np.isfinite(space.high), space.high, 1.0)
    actions = [(low + high) / 2.0, high, *(space.sample() for _ in range(_TRIALS))]
    twin.reset(seed=0)
    taken, controls = [], []
    at.data.warning.number[RESETS] = 0
    for action in actions:
        twin.step(np.array(action, dtype=space.dtype))
        if at.data.warning.number[RESETS].any():  # MuJoCo has reset the state, and the control with it
            twin.reset()
            at.data.warning.number[RESETS] = 0
            continue
        taken.append(action)
        controls.append(at.data.ctrl.copy())
    if len(taken) < _FEWEST:
        raise RuntimeError(f"in {len(actions) - len(taken)} of {len(actions)} steps its simulation diverged")
    return np.array(taken, dtype=space.dtype).astype(np.float64), np.array(controls)
