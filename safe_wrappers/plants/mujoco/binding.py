"""What a `MujocoPlant` needs of an env: a model, the length of a step, and what the env makes of an action.

An env may count its actions in other units than its model's controls: the hands of gymnasium-robotics take actions in
[-1, 1] and put them onto the actuators' ranges. The map is found by stepping a copy of the env, and tried there.
"""

import copy
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.errors import Array, ConfigurationError, UnsupportedEnvError, positive
from safe_wrappers.plants.copies import EnvCopier
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.mujoco.model import RESETS

ModelOf = Callable[[Any], mujoco.MjModel]
"""Takes the unwrapped env; returns its model."""
DataOf = Callable[[Any], mujoco.MjData]
"""Takes the unwrapped env; returns its data."""

_LAST_INTEGRATOR = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
_TRIALS: Final = 100
_FEWEST: Final = 10  # of them that must not have diverged
_ROUNDING: Final = 1e-6
"""Of controls, as a share of the largest one seen, and of states: envs may compute in single precision."""
_INSTEAD: Final = (
    "Simulate the env itself: PredictiveShield with SimulatorPlant(); or use AnalyticPlant(f=..., g=..., state=...) "
    "with your own f and g."
)


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
    (*expected, step_s), (*found, own_step_s) = (
        (m.nq, m.nv, m.nu, m.opt.timestep) for m in (source.model, model)
    )
    if found != expected or not np.isclose(own_step_s, step_s, rtol=1e-9, atol=0.0):
        raise ConfigurationError(
            "the plant's model must have the env's joints and actuators (nq, nv, nu) and timestep: expected "
            f"{expected} and {step_s} s, got {found} and {own_step_s} s"
        )
    if model.opt.integrator > _LAST_INTEGRATOR:
        raise UnsupportedEnvError(
            "the model's integrator is 'discrete' (MuJoCo 3.13 and later), whose accelerations are those of a "
            "whole step, which MujocoPlant's g is not; it handles: Euler, RK4, implicit, implicitfast. Use "
            "AnalyticPlant with your own f and g."
        )
    return model


def physics_steps(raw: Any, source: Any = None, control_dt: float | None = None) -> int:
    """How many physics substeps an unwrapped MuJoCo env takes with one action.

    Args:
        raw: Says it by `frame_skip`, `n_substeps` or `dt` (s), or holds the env that steps its physics and says it.
            Where functions find its data, by `dt` alone: what else it counts may be other steps.
        source: Has its `.model` and `.data`; None: the env itself.
        control_dt: How long it holds an action, s, for an env that does not say so.

    Raises:
        UnsupportedEnvError: Nobody says it.
        ConfigurationError: Not a whole number of physics steps, none, or by `control_dt` another than by the env.
    """
    own = source is None or source is raw
    env = raw
    if own and not hasattr(raw, "frame_skip"):
        # The physics may be stepped by an env that this one holds: a maze holds its robot's.
        held = (e for e in vars(raw).values() if isinstance(e, gym.Env))
        env = next((e for e in held if getattr(e, "data", None) is raw.data), raw)
    timestep = float((raw if own else source).model.opt.timestep)
    counts = (getattr(env, name, None) for name in ("frame_skip", "n_substeps") if own)
    said: float | None = next((int(count) for count in counts if count is not None), None)
    if said is None and getattr(env, "dt", None) is not None:
        said = round(float(env.dt) / timestep)
    if control_dt is None and said is None:
        raise UnsupportedEnvError(
            f"{raw} does not say how long a step lasts: give it an attribute dt (s) or frame_skip (physics "
            "steps), or pass MujocoPlant(control_dt=...), in seconds"
        )
    steps = said if control_dt is None else positive("control_dt", control_dt, "s") / timestep
    assert steps is not None
    count = round(steps)
    if count < 1 or not np.isclose(steps, count, rtol=1e-6) or said not in (None, count):
        by_control_dt = "no control_dt" if control_dt is None else f"{steps:g} by control_dt"
        raise ConfigurationError(
            f"expected a control step of a whole number of physics steps of {timestep} s, at least 1, and control_dt "
            f"to agree with the env; got {by_control_dt}, and {'nothing' if said is None else said} by {raw}: leave "
            "control_dt (s) out where the env says it by frame_skip, n_substeps or dt; where it does not, give a "
            "multiple of the timestep"
        )
    return count


def actions_are_controls(space: gym.Space[Any], lower: Array, upper: Array) -> bool:
    """Whether an action space is the model's control range, shapes (nu,), where there is one."""
    if not isinstance(space, gym.spaces.Box) or space.shape != lower.shape:
        return False
    limited = np.isfinite(lower)
    rounding = 0.5e-6 * (upper - lower)[limited]
    ends = (space.low, lower), (space.high, upper)
    return all(np.allclose(one[limited], other[limited], atol=rounding) for one, other in ends)


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


class ActionMap(NamedTuple):
    """`control = offset + scale * action`, elementwise."""

    offset: Array  #: the model's control at the action zero, shape (nu,)
    scale: Array  #: change of the control per unit of action, shape (nu,)
    low: Array  #: smallest action, shape (nu,)
    high: Array  #: largest action, shape (nu,)

    @property
    def is_identity(self) -> bool:
        """Whether an action is the control."""
        return not self.offset.any() and bool((self.scale == 1.0).all())

    def control(self, action: Array) -> Array:
        """The model's control, shape (nu,)."""
        return self.offset + self.scale * action

    def action(self, control: Array) -> Array:
        """The action for a control, shape (nu,); the one nearest to zero where actions do nothing."""
        idle = self.scale == 0.0
        found = np.where(idle, 0.0, control - self.offset) / np.where(idle, 1.0, self.scale)
        return np.clip(found, self.low, self.high)

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
        idle, ends = self.scale == 0.0, [self.action(end) for end in (least, most)]
        return np.where(idle, self.low, np.minimum(*ends)), np.where(idle, self.high, np.maximum(*ends))

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


def action_map_of(env: gym.Env[Any, Any], source: Any, lower: Array, upper: Array) -> ActionMap | None:
    """The map by which an env makes controls of actions, found on a copy of it; None where an action is a control.

    Args:
        env: It and its random generator stay as they are.
        source: Has the unwrapped env's `.model` and `.data`.
        lower: Of the model's control range, shape (nu,), or -inf.
        upper: Likewise, or inf.

    Raises:
        UnsupportedEnvError: No copy can be stepped, or the env does something else with its actions.
    """
    space, name = env.action_space, name_of(env)
    ranges_agree = actions_are_controls(space, lower, upper)
    if ranges_agree and np.isfinite(lower).all():
        return None
    ranges = f"the action space is {space}, the model's control range {lower} to {upper}"
    if space != env.unwrapped.action_space:
        wrong = f"a wrapper of {name} changes its action space; the filter must be inside of that wrapper: {ranges}"
        raise UnsupportedEnvError(wrong)
    if moves_by_displacement(env.unwrapped):
        raise UnsupportedEnvError(
            f"{name} moves its gripper by displacements: take DisplacementPlant(), or leave plant out"
        )
    in_its_step = f"{name} rescales or limits actions in its own step"
    if space.shape != lower.shape:
        raise UnsupportedEnvError(
            f"{in_its_step}: it has not one action for each control. Use AnalyticPlant(f=..., g=..., state=...) with "
            f"your own f and g: {ranges}"
        )
    assert isinstance(space, gym.spaces.Box)  # the filter has refused every other space
    box = space.low.astype(np.float64), space.high.astype(np.float64)
    try:
        actions, controls = _tried(env.unwrapped, source, space)
    except Exception as error:
        if ranges_agree:
            return None
        raise UnsupportedEnvError(
            f"{in_its_step}, and no copy of it can be stepped to find out how ({type(error).__name__}: {error}). "
            f"{_INSTEAD}"
        ) from error
    guesses = [_ends_to_ends(source.model, box), _through_two(actions, controls, box)]
    errors = [np.abs(controls - g.control(actions)) for g in guesses]
    best = int(np.argmin([np.nan_to_num(error, nan=np.inf).max() for error in errors]))
    worst, allowed = errors[best].max(axis=0), _ROUNDING * np.abs(controls).max(axis=0)
    if not (worst <= allowed).all():
        i = int(np.nanargmax(worst - allowed))
        raise UnsupportedEnvError(
            f"{in_its_step}, and not by control = offset + scale * action: in {_TRIALS} steps of random actions its "
            f"controls were up to {worst[i]:.3g} away from that, at actuator {source.model.actuator(i).name or i!r}, "
            f"which had {controls[:, i].min():.3g} to {controls[:, i].max():.3g}. The map may depend on its state. "
            f"{_INSTEAD}"
        )
    return None if ranges_agree and guesses[best].is_identity else guesses[best]


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
