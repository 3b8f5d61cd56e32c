"""From symptom to tool: what is wrong with an env and a policy, and which wrapper treats it."""

import itertools
import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, cast

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.constraints.joints import driven_joints
from safe_wrappers.control.vehicle import slip_ratio
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnsupportedEnvError,
    finite_action,
    whole_number,
)
from safe_wrappers.plants.env_checks import check_timing, name_of, wrappers_of
from safe_wrappers.plants.mujoco.model import HINGE, fixed_bodies, weight_n
from safe_wrappers.wrappers.monitors import BalanceMonitor, ContactMonitor
from safe_wrappers.wrappers.protect import protect
from safe_wrappers.wrappers.recipes import recipe_of

__all__ = ["SYMPTOMS", "Finding", "diagnose"]

Env = gym.Env[Any, Any]
Driver = Callable[[Any], Any]
"""Gives an action for an observation; one that has `reset()` is told so that an episode begins."""

_DIVERGED: Final = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]
_ROUND: Final = [int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)]
_PRESSED: Final = 0.02
"""Share of a joint's range by which it is beyond its stop."""


class NotMeasuredError(Exception):
    """Why a symptom cannot be measured in an env; never leaves this module."""


@dataclass(frozen=True)
class Finding:
    """One symptom in one env.

    Attributes:
        symptom: Its name, a key of `SYMPTOMS`.
        figure: What was measured, in the symptom's unit; NaN where it could not be measured.
        code: Of a symptom that is there the lines that treat it in `env`, or a comment that says what helps.
        missing: Why it could not be measured; "" where it was.
    """

    symptom: str
    figure: float = math.nan
    code: str = ""
    missing: str = ""

    @property
    def present(self) -> bool:
        """Whether the symptom is there."""
        return self.figure >= SYMPTOMS[self.symptom].threshold

    def __str__(self) -> str:
        """For a terminal: the verdict, and of a symptom that is there the lines to paste."""
        symptom, unit = SYMPTOMS[self.symptom], SYMPTOMS[self.symptom].unit
        numbers = self.figure, symptom.threshold
        figure, limit = (f"{100 * n:.3g} %" if unit == "share" else f"{n:.3g} {unit}" for n in numbers)
        words = self.missing or f"{symptom.title}: {figure} (a symptom from {limit} on)"
        verdict = "unknown" if self.missing else "FOUND" if self.present else "not found"
        return "\n      ".join([f"  {verdict:9} {self.symptom:17} {words}", *self.code.splitlines()])


def diagnose(env: Env, policy: Any = None, steps: int = 2000, seed: int = 0) -> list[Finding]:
    """Look for symptoms in an env and a policy, and name the wrapper that treats each.

    The env is driven by the policy, or without one by an attacker: random corners of the action space, each held for
    15 steps. A symptom is ranked by its figure over its threshold. Diagnose the env with the wrapper around it to see
    what that leaves.

    Args:
        env: With a one-dimensional Box action space. It is stepped and reset, and otherwise left as it is.
        policy: A function of the observation, or a model with `predict(observation, deterministic=True)`. A function
            that has `reset()` is told so where an episode begins.
        steps: Control steps.
        seed: Of the attacker and of resets.

    Returns:
        One finding per symptom, the most severe first; then what is not there, then what could not be measured.

    Raises:
        UnsupportedEnvError: No Gymnasium env, or one with other actions.
        ConfigurationError: A policy that is none.
        ActionError: The policy's action has another shape than the env's, or is not finite; the env never gets it.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> first, *_ = sw.diagnose(gym.make("SafeRover-v0"), steps=200)
        >>> print(first.code)
        env = sw.SlipLimiter(env, wheels=['front_left', 'front_right', 'rear_left', 'rear_right'])
    """
    if not isinstance(env, gym.Env):
        raise UnsupportedEnvError(f"diagnose takes one env, as gym.make returns it; got {env!r}")
    whole_number("steps", steps, 2, "control steps")
    attacked = policy is None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of what the figures count
        recording = record(env, attacker(env, seed) if attacked else policy_driver(policy), steps, seed)
    findings = [_found(name, recording, attacked) for name in SYMPTOMS]
    ranks = {one: -1.0 if one.missing else one.figure / SYMPTOMS[one.symptom].threshold for one in findings}
    return sorted(findings, key=ranks.__getitem__, reverse=True)


def _found(name: str, recording: "Recording", attacked: bool) -> Finding:
    """One symptom, with its lines if it is there."""
    symptom = SYMPTOMS[name]
    try:
        if attacked and symptom.policies_only:
            raise NotMeasuredError("an attacker says nothing of it: give a policy")
        figure = symptom.measure(recording)
    except NotMeasuredError as error:
        return Finding(name, missing=str(error))
    return Finding(name, figure, symptom.tool(recording) if figure >= symptom.threshold else "")


# Drivers, and what they do to an env ------------------------------------------------------------------------------


def attacker(env: Env, seed: int) -> Driver:
    """Random corners of the action space, each held for 15 steps."""
    rng, (low, high) = np.random.default_rng(seed), _box(env)
    corners = (np.where(rng.random(low.shape) < 0.5, low, high) for _ in itertools.count())
    actions = (corner.astype(env.action_space.dtype) for corner in corners for _ in range(15))
    return lambda observation: next(actions)


def policy_driver(policy: Any) -> Driver:
    """A function of the observation, or a model with `predict`, asked deterministically."""
    predict = getattr(policy, "predict", None)
    if predict is not None:
        return lambda observation: predict(observation, deterministic=True)[0]
    if not callable(policy):
        raise ConfigurationError(
            "policy is a function of the observation, or has predict(observation, deterministic=True); "
            f"got {policy!r}"
        )
    return cast(Driver, policy)


def _box(env: Env) -> tuple[Array, Array]:
    """The ends of the action space, shape (m,); where it has none, -1 and 1. Of a `ChunkHandover`, chunks of one."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or math.prod(space.shape) != space.shape[-1]:
        raise UnsupportedEnvError(f"diagnose needs a Box action space of shape (m,), got {space}")
    low, high = (np.ravel(end).astype(np.float64) for end in (space.low, space.high))
    return np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)


@dataclass
class Recording:
    """What one driver did in k control steps. What MuJoCo says is empty for an env without it."""

    env: Env
    infos: list[dict[str, Any]]  # with those of a contact and a balance monitor, where the env allows them
    struck: list[tuple[str, ...] | None]  # bodies with the largest force
    first: np.ndarray  # steps of episodes, shape (k,)
    terminated: np.ndarray
    executed: Array  # actions that the unwrapped env was given, shape (k, m)
    qpos: Array  # after each step, shape (k, nq)
    qvel: Array
    diverged: np.ndarray  # MuJoCo has found numbers that are not finite, and has reset its data, shape (k,)

    def of_info(self, key: str) -> Array:
        """A number of each step's info, shape (k,); NaN where a step does not report it."""
        return np.array([float(info.get(key, np.nan)) for info in self.infos])

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model of the env; `NotMeasuredError` where it has none."""
        model = getattr(self.env.unwrapped, "model", None)
        if not isinstance(model, mujoco.MjModel):
            raise NotMeasuredError("the env has no MuJoCo model")
        return model

    def of_monitor(self, key: str) -> Array:
        """The same of a monitor; `NotMeasuredError` where it sees too little of this env."""
        monitor, _, _ = key.partition("/")
        if np.mean(self.of_info(f"{monitor}/partial") == 0.0) < 0.5:
            raise NotMeasuredError(
                f"a {monitor.title()}Monitor does not fit around this env, or cannot make its control steps once more"
            )
        return self.of_info(key)


class _Spy(gym.Wrapper[Any, Any, Any, Any]):
    """Remembers the last action that the unwrapped env was given; a wrapper, so that envs can be copied with it."""

    given: Array

    def step(self, action: Any) -> Any:
        self.given = np.array(action, dtype=float)
        return self.env.step(action)


def record(env: Env, driver: Driver, steps: int, seed: int) -> Recording:
    """Drive the env for so many control steps, episode after episode.

    Raises:
        ActionError: The driver gave an action of another shape, or one that is not finite; the env never gets it.
    """
    size, data = _box(env)[0].size, getattr(env.unwrapped, "data", None)
    data = data if isinstance(data, mujoco.MjData) else None
    contacts, monitored = None, gym.Wrapper(env)
    with suppress(ConfigurationError):  # no MuJoCo, nothing that stands, a wrapper whose step is many
        contacts = monitored = ContactMonitor(monitored)
        monitored = BalanceMonitor(monitored)
    rows: list[tuple[Any, ...]] = []
    observation, over, episode = None, True, 0
    *_, innermost = wrappers_of(monitored)
    innermost.env = spy = _Spy(env.unwrapped)
    try:
        for _ in range(steps):
            first = over
            if first:
                observation, _ = monitored.reset(seed=seed + episode)
                getattr(driver, "reset", lambda: None)()
                episode += 1
            action = finite_action(driver(observation), size)
            before = _divergences(data)
            observation, _, terminated, truncated, info = monitored.step(action)
            over = bool(terminated or truncated)
            struck = None if contacts is None else contacts.peak_bodies
            diverged = _divergences(data) > before
            state = (np.empty(0), np.empty(0)) if data is None else (data.qpos.copy(), data.qvel.copy())
            rows.append((info, struck, first, terminated, spy.given, *state, diverged))
    finally:
        innermost.env = spy.env
    infos, bodies, *arrays = zip(*rows, strict=True)
    return Recording(env, list(infos), list(bodies), *map(np.array, arrays))


def _divergences(data: mujoco.MjData | None) -> int:
    return 0 if data is None else int(sum(data.warning[kind].number for kind in _DIVERGED))


# Symptoms: how each is measured, and which wrapper treats it ------------------------------------------------------


class Symptom(NamedTuple):
    """One row of the table of symptoms."""

    title: str
    threshold: float  # from which on it is a symptom
    unit: str  # of the threshold and of the figure
    measure: Callable[[Recording], float]  # the figure; or a `NotMeasuredError`
    tool: Callable[[Recording], str]  # lines that treat it in `env`, or a comment
    policies_only: bool = False  # an attacker has this symptom of itself


def _filtered(constraint: str, **arguments: Any) -> str:
    """Lines that put a filter with one constraint around `env`."""
    given = ", ".join(f"{name}={value!r}" for name, value in arguments.items())
    return f"limit = sw.constraints.{constraint}({given})\nenv = sw.CBFActionFilter(env, [limit])"


def _braking(recording: Recording) -> int:
    """Control steps in which the speeds that were seen are braked, by the changes of speed that were usual."""
    change = np.abs(np.diff(recording.qvel, axis=0)).max(axis=1)[~recording.first[1:]]
    usual = float(np.median(change)) if change.size else 0.0
    # At most 60: each costs a forecast of as many.
    return int(np.clip(np.ceil(np.abs(recording.qvel).max() / max(usual, 1e-9)), 5, 60))


def _recommended(env: Env) -> list[str]:
    """Kinds of the constraints that `protect` has for the env; none where it refuses what is around it."""
    with suppress(ConfigurationError):
        if env.spec is not None and recipe_of(env.spec.id) is not None:
            return [type(constraint).__name__ for constraint in protect(env).constraints]
    return []


def _beyond(recording: Recording) -> tuple[list[str], Array]:
    """Driven joints with stops, and how far each is beyond them, as a share of its range, shape (k, joints)."""
    model = recording.model
    joints = [j for j in driven_joints(model) if model.jnt_limited[j]]
    low, high = model.jnt_range[joints].T
    position = recording.qpos[:, model.jnt_qposadr[joints]]
    return [model.joint(j).name for j in joints], np.maximum(low - position, position - high) / (high - low)


def _measure_limits(recording: Recording) -> float:
    """The share of steps with a cost, or with a driven joint beyond its stop."""
    violated, judged = recording.of_info("cost") > 0.0, any("cost" in info for info in recording.infos)
    try:
        violated |= (_beyond(recording)[1] > _PRESSED).any(axis=1)
    except NotMeasuredError as error:
        if not judged:
            raise NotMeasuredError(f"the env reports no cost in info, and {error}") from None
    return float(violated.mean())


def _treat_limits(recording: Recording) -> str:
    if _recommended(recording.env):
        return "env = sw.protect(env)"
    with suppress(NotMeasuredError):
        names, beyond = _beyond(recording)
        if (beyond > _PRESSED).any():
            pressed = [name for name, shares in zip(names, beyond.T, strict=True) if shares.max() > 0.0]
            return _filtered("JointPositionLimit", joints=pressed, margin=0.0, horizon=_braking(recording))
    words = "# Choose a backup that stops your machine, and a horizon that is as long as it takes.\n"
    return words + _filtered("PredictiveShield", h="cost", horizon=20, backup="zero")


def _measure_steps(recording: Recording) -> float:
    """The largest change of a command, as a share of its range, in all but one in a hundred control steps."""
    low, high = _box(recording.env.unwrapped)
    commands = recording.executed / np.where(high > low, high - low, 1.0)
    steps = np.abs(np.diff(commands, axis=0)).max(axis=1)
    return float(np.percentile(steps[~recording.first[1:]], 99.0))


def _treat_steps(recording: Recording) -> str:
    """A handover of single actions that lets commands change by 5 % of their range in a control step."""
    low, high = _box(recording.env)
    try:
        control_dt = check_timing(recording.env)
    except ConfigurationError as error:
        return f"# ChunkHandover(env, chunk_size=1, execution_horizon=1) is refused: {error}"
    rate = float(f"{0.05 * float((high - low).min()) / control_dt:.4g}")
    return (
        "# If the policy gives chunks, pass them whole: ChunkHandover(env, chunk_size=..., execution_horizon=...).\n"
        f"env = sw.ChunkHandover(env, chunk_size=1, execution_horizon=1, rate_limit={rate})"
    )


def _measure_forces(recording: Recording) -> float:
    """The largest force between two bodies above the usual one, in weights of all that moves."""
    weight = weight_n(recording.model)
    if recording.diverged.any():
        return np.inf
    forces = recording.of_monitor("contact/peak_force")
    # What presses all the time, maybe where it cannot move, is no impact.
    return max(float(np.nanmax(forces) - np.nanmedian(forces)), 0.0) / weight


def _treat_forces(recording: Recording) -> str:
    """`protect`, where it keeps the machine clear; else a limit of the pair that hit hardest."""
    if recording.diverged.any():
        return "# The simulation diverged: a shorter timestep, softer contacts, or weaker actuators."
    if any(kind.endswith("Clearance") for kind in _recommended(recording.env)):
        return "env = sw.protect(env)"
    forces = np.nan_to_num(recording.of_info("contact/peak_force"), nan=0.0)
    k = int(np.argmax(forces))
    depth, pair = float(recording.of_info("contact/penetration")[k]), recording.struck[k]
    if pair is None or not all(pair) or not depth > 0.0:  # a body without a name cannot be given
        return "# Limit the speed of what hits: ImpactSpeedLimit, or a lower speed of the whole machine."
    model = recording.model
    fixed = fixed_bodies(model)
    names = sorted(pair, key=lambda name: bool(fixed[model.body(name).id]))
    return _filtered(
        "ImpactSpeedLimit",
        bodies=names[:1],
        against=names[1:],
        force_limit=float(f"{forces[k] / 3.0:.4g}"),
        stiffness=float(f"{forces[k] / depth:.4g}"),
        horizon=_braking(recording),
    )


def wheels(model: mujoco.MjModel) -> dict[int, float]:
    """Driven joints that turn a round geom about a level axle without a stop; with its radius, m."""
    found, data = {}, mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    for j in driven_joints(model):
        turns = model.jnt_type[j] == HINGE and not model.jnt_limited[j] and abs(data.xaxis[j, 2]) < 0.5
        own = (model.geom_bodyid == model.jnt_bodyid[j]) & np.isin(model.geom_type, _ROUND) & touching
        if turns and own.any() and model.joint(j).name:
            found[j] = float(model.geom_size[own, 0].max())
    return found


def _measure_slip(recording: Recording) -> float:
    """The share of steps with a slip above 0.2, beyond the peak of traction on all usual grounds."""
    model = recording.model
    rolling = wheels(model)
    if not rolling:
        raise NotMeasuredError("no driven joint turns a wheel")
    ratios, velocity, data = [], np.zeros(6), mujoco.MjData(model)
    for data.qpos[:], data.qvel[:] in zip(recording.qpos, recording.qvel, strict=True):
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        for j, radius in rolling.items():
            body, axle = int(model.jnt_bodyid[j]), data.xaxis[j]
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            ahead = np.array([axle[1], -axle[0]]) / max(np.hypot(axle[0], axle[1]), 1e-6)
            rim = radius * float(velocity[:3] @ axle)
            ratios.append(slip_ratio(rim, float(ahead @ velocity[3:5]), 0.5))  # m/s, as of `SlipLimiter`
    return float((np.abs(ratios).reshape(-1, len(rolling)).max(axis=1) > 0.2).mean())


def _treat_slip(recording: Recording) -> str:
    names = [recording.model.joint(j).name for j in wheels(recording.model)]
    return f"env = sw.SlipLimiter(env, wheels={names})"


def _measure_balance(recording: Recording) -> float:
    """The share of steps with a foot at the edge of its friction cone, or outside of the support polygon."""
    if wheels(recording.model):
        raise NotMeasuredError("it rolls: its wheels are judged by their slip")
    friction, zmp = (recording.of_monitor(f"balance/{key}") for key in ("friction_used", "zmp_margin"))
    if not ((friction == 0.0).any() or recording.terminated.any()):
        raise NotMeasuredError(f"{name_of(recording.env)} never left the ground: it does not balance")
    return float(((friction >= 1.0) | (zmp < 0.0)).mean())


SYMPTOMS: Final = {
    "limits": Symptom(
        "unsafe actions near obstacles or limits", 0.02, "share", _measure_limits, _treat_limits
    ),
    "command_steps": Symptom(
        "commands that spike at switches or chunk seams",
        0.2,
        "of the range",
        _measure_steps,
        _treat_steps,
        policies_only=True,
    ),
    "contact_forces": Symptom(
        "impacts with large forces, or a simulation that diverges",
        60.0,
        "weights",
        _measure_forces,
        _treat_forces,
    ),
    "wheel_slip": Symptom("wheels that spin or lock", 0.05, "share", _measure_slip, _treat_slip),
    "balance": Symptom(
        "feet that slide or tip",
        0.05,
        "share",
        _measure_balance,
        lambda recording: "env = sw.WholeBodyFilter(env, joint_tolerance=None)",
        policies_only=True,
    ),
}
"""By name."""
