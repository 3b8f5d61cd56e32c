"""The table of symptoms: how each is measured, from when on it counts, and which wrapper treats it."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from safe_wrappers.constraints import ImpactSpeedLimit, JointPositionLimit, PredictiveShield
from safe_wrappers.constraints.joints import driven_joints
from safe_wrappers.control.vehicle import slip_ratio
from safe_wrappers.diagnosis.recording import Env, NotMeasuredError, Recording, box
from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.plants.env_checks import check_timing, name_of
from safe_wrappers.plants.mujoco.model import HINGE, fixed_bodies, weight_n
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.chunk_handover import ChunkHandover
from safe_wrappers.wrappers.presets import SlipLimiter, WholeBodyFilter
from safe_wrappers.wrappers.protect import protect
from safe_wrappers.wrappers.recipes import recipe_of

PRESSED = 0.02
"""Share of a joint's range by which it is beyond its stop."""
_SPHERE, _CYLINDER = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)


class Treatment(NamedTuple):
    """What helps."""

    code: str  # how the wrapper is typed; "" where none can be tried
    wrap: Callable[[Env], Env] | None  # does the same to an env
    advice: str = ""  # what to do besides, or why no wrapper can be tried


class Symptom(NamedTuple):
    """One row of the table of symptoms."""

    title: str
    threshold: float  # from which on it is a symptom, in `unit`
    unit: str  # "share" is one of control steps
    measure: Callable[[Recording], float]  # the figure of one driver, in `unit`; or a `NotMeasuredError`
    treatment: Callable[[Recording], Treatment]
    policies_only: bool = False  # random and attacking drivers have this symptom of themselves


def _typed(arguments: dict[str, Any]) -> list[str]:
    return [f"{name}={value!r}" for name, value in arguments.items()]


def _wrapped(wrapper: Callable[..., Env], advice: str = "", **arguments: Any) -> Treatment:
    """A wrapper of the package, or `protect`, with arguments whose `repr` is how they are typed."""
    code = f"env = sw.{wrapper.__name__}({', '.join(['env', *_typed(arguments)])})"
    return Treatment(code, lambda env: wrapper(env, **arguments), advice)


def _filtered(constraint: Callable[..., Any], advice: str = "", **arguments: Any) -> Treatment:
    """A filter with one constraint of `safe_wrappers.constraints`; arguments as of `_wrapped`."""
    limit = f"sw.constraints.{constraint.__name__}({', '.join(_typed(arguments))})"
    return Treatment(
        f"limit = {limit}\nenv = sw.CBFActionFilter(env, [limit])",
        lambda env: CBFActionFilter(env, [constraint(**arguments)]),
        advice,
    )


def _recommended(env: Env) -> list[str]:
    """Kinds of the constraints that `protect` has for the env; none where it refuses what is around it."""
    if env.spec is None or recipe_of(env.spec.id) is None:
        return []
    try:
        return [type(constraint).__name__ for constraint in protect(env).constraints]
    except ConfigurationError:
        return []


# limits: declared costs, joints that press their stops


def _beyond(recording: Recording) -> tuple[list[str], Array]:
    """Driven joints with stops, and how far each is beyond them, as a share of its range, shape (k, joints)."""
    model = recording.model
    if model is None:
        return [], np.zeros((len(recording.first), 0))
    joints = [j for j in driven_joints(model) if model.jnt_limited[j]]
    low, high = model.jnt_range[joints].T
    position = recording.qpos[:, model.jnt_qposadr[joints]]
    return [model.joint(j).name for j in joints], np.maximum(low - position, position - high) / (high - low)


def _measure_limits(recording: Recording) -> float:
    """The share of steps with a cost, or with a driven joint beyond its stop."""
    cost = recording.of_info("cost")
    if np.isnan(cost).all() and recording.model is None:
        raise NotMeasuredError(
            "the env reports no cost in info, and has no MuJoCo model whose limits could be read"
        )
    pressed = (_beyond(recording)[1] > PRESSED).any(axis=1)
    return float(((cost > 0.0) | pressed).mean())


def _treat_limits(recording: Recording) -> Treatment:
    if _recommended(recording.env):
        return _wrapped(protect)
    names, beyond = _beyond(recording)
    if (beyond > PRESSED).any():
        pressed = [name for name, shares in zip(names, beyond.T, strict=True) if shares.max() > 0.0]
        return _filtered(JointPositionLimit, joints=pressed, margin=0.0, horizon=recording.braking_horizon)
    advice = "Choose a backup that stops your machine, and a horizon that is as long as it takes."
    return _filtered(PredictiveShield, advice, h="cost", horizon=20, backup="zero")


# command_steps: commands that spike


def command_steps(recording: Recording) -> Array:
    """The largest change of a command in each step, as a share of the range, shape (k,); 0 at an episode's start."""
    low, high = box(recording.env.unwrapped)
    commands = recording.executed / np.where(high > low, high - low, 1.0)
    steps = np.abs(np.diff(commands, axis=0, prepend=commands[:1])).max(axis=1)
    return np.asarray(np.where(recording.first, 0.0, steps))


def _measure_steps(recording: Recording) -> float:
    """The largest command steps, but for one in a hundred control steps."""
    return float(np.percentile(command_steps(recording), 99.0))


def _treat_steps(recording: Recording) -> Treatment:
    """A handover of single actions that lets commands change by 5 % of their range in a control step."""
    low, high = box(recording.env)
    rate = float(f"{0.05 * float((high - low).min()) / check_timing(recording.env):.4g}")
    chunks = "If the policy gives chunks, pass them whole: ChunkHandover(env, chunk_size=..., execution_horizon=...)."
    return _wrapped(ChunkHandover, chunks, chunk_size=1, execution_horizon=1, rate_limit=rate)


# contact_forces: peak forces against the machine's weight


def _measure_forces(recording: Recording) -> float:
    """The largest force between two bodies above the usual one, in weights of all that moves."""
    weight = weight_n(recording.needed_model)
    forces = recording.of_info("contact/peak_force")
    if np.isnan(forces).all():
        raise NotMeasuredError("no ContactMonitor goes around this env: a step of its outer wrapper is many")
    finite = np.isfinite(recording.qpos).all() and np.isfinite(recording.qvel).all()
    if recording.diverged.any() or not finite:
        return np.inf
    recording.check_replays()
    # What presses all the time, maybe where it cannot move, is no impact.
    return max(float(np.nanmax(forces) - np.nanmedian(forces)), 0.0) / weight


def _treat_forces(recording: Recording) -> Treatment:
    """`protect`, where it keeps the machine clear; else a limit of the pair that hit hardest."""
    if recording.diverged.any():
        advice = "The simulation diverged: a shorter timestep, softer contacts, or weaker actuators."
        return Treatment("", None, advice)
    if any(kind.endswith("Clearance") for kind in _recommended(recording.env)):
        return _wrapped(protect)
    forces = np.nan_to_num(recording.of_info("contact/peak_force"), nan=0.0)
    k = int(np.argmax(forces))
    depth, pair = float(recording.of_info("contact/penetration")[k]), recording.struck[k]
    if pair is None or not depth > 0.0:
        advice = "Limit the speed of what hits: ImpactSpeedLimit, or a lower speed of the whole machine."
        return Treatment("", None, advice)
    model = recording.needed_model
    fixed = fixed_bodies(model)
    names = sorted(pair, key=lambda name: bool(fixed[model.body(name).id]))
    return _filtered(
        ImpactSpeedLimit,
        bodies=names[:1],
        against=names[1:],
        force_limit=float(f"{forces[k] / 3.0:.4g}"),
        stiffness=float(f"{forces[k] / depth:.4g}"),
        horizon=recording.braking_horizon,
    )


# wheel_slip: wheels that spin or lock


def wheels(model: mujoco.MjModel) -> dict[int, float]:
    """Driven joints that turn a round geom about a level axle without a stop; with its radius, m."""
    found, data = {}, mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for j in driven_joints(model):
        axle = data.xaxis[j]
        turns = model.jnt_type[j] == HINGE and not model.jnt_limited[j] and abs(axle[2]) < 0.5
        for g in np.flatnonzero(model.geom_bodyid == model.jnt_bodyid[j]):
            along = abs(data.geom_xmat[g].reshape(3, 3)[:, 2] @ axle) > 0.99
            round_ = model.geom_type[g] == _SPHERE or (model.geom_type[g] == _CYLINDER and along)
            touches = model.geom_contype[g] or model.geom_conaffinity[g]
            off_axle = np.linalg.norm(np.cross(data.geom_xpos[g] - data.xanchor[j], axle))
            radius = float(model.geom_size[g, 0])
            if turns and round_ and touches and off_axle < 0.05 * radius and model.joint(j).name:
                found[j] = radius
    return found


def slips(recording: Recording) -> Array:
    """The slip ratio of each wheel after each step, shape (k, wheels)."""
    model = recording.needed_model
    rolling = wheels(model)
    if not rolling:
        raise NotMeasuredError("no driven joint turns a wheel")
    ratio, velocity, data = np.zeros((len(recording.qpos), len(rolling))), np.zeros(6), mujoco.MjData(model)
    for k in range(len(ratio)):
        data.qpos[:], data.qvel[:] = recording.qpos[k], recording.qvel[k]
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            compute(model, data)
        for i, (j, radius) in enumerate(rolling.items()):
            body, axle = int(model.jnt_bodyid[j]), data.xaxis[j]
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            ahead = np.array([axle[1], -axle[0]]) / max(np.hypot(axle[0], axle[1]), 1e-6)
            rim = radius * float(velocity[:3] @ axle)
            ratio[k, i] = slip_ratio(rim, float(ahead @ velocity[3:5]), 0.5)  # m/s, as of `SlipLimiter`
    return ratio


def _measure_slip(recording: Recording) -> float:
    """The share of steps with a slip above 0.2, beyond the peak of traction on all usual grounds."""
    return float((np.abs(slips(recording)).max(axis=1) > 0.2).mean())


def _treat_slip(recording: Recording) -> Treatment:
    model = recording.needed_model
    return _wrapped(SlipLimiter, wheels=[model.joint(j).name for j in wheels(model)])


# balance: feet that slide or tip


def _measure_balance(recording: Recording) -> float:
    """The share of steps with a foot at the edge of its friction cone, or outside of the support polygon."""
    if recording.model is not None and wheels(recording.model):
        raise NotMeasuredError("it rolls: its wheels are judged by their slip")
    friction, zmp = recording.of_info("balance/friction_used"), recording.of_info("balance/zmp_margin")
    if np.isnan(friction).all():
        raise NotMeasuredError(
            "no BalanceMonitor goes around this env: nothing stands on fixed ground by friction"
        )
    recording.check_replays()
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
        lambda recording: _wrapped(WholeBodyFilter, joint_tolerance=None),
        policies_only=True,
    ),
}
"""By name."""
