"""Wheels that spin or lock: their slip against the ground."""

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.constraints.limits.joints import driven_joints
from safe_wrappers.control.vehicle import slip_ratio
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording
from safe_wrappers.diagnosis.symptom import (
    Measured,
    NotMeasuredError,
    Symptom,
    Treatment,
    require_physics,
    wrapped,
)
from safe_wrappers.plants.mujoco.model import HINGE
from safe_wrappers.wrappers.presets import SlipLimiter

SLIPS = 0.2
"""Slip ratio from which on a wheel is beyond the peak of its traction on all usual grounds."""
REGULARIZATION = 0.5
"""m/s, as of `SlipLimiter`."""
_LEVEL = 0.5
"""Of the vertical part of an axle's direction: a wheel does not turn about a steep one."""
_SPHERE, _CYLINDER = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)


def wheels(model: mujoco.MjModel) -> dict[int, float]:
    """Driven joints that turn a round geom about a level axle without a stop; with its radius, m."""
    found, data = {}, mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for j in driven_joints(model):
        level = abs(data.xaxis[j, 2]) < _LEVEL
        if model.jnt_type[j] != HINGE or model.jnt_limited[j] or not level or not model.joint(j).name:
            continue
        for g in np.flatnonzero(model.geom_bodyid == model.jnt_bodyid[j]):
            axis = np.zeros(3)
            mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), model.geom_quat[g])
            touches = model.geom_contype[g] or model.geom_conaffinity[g]
            off_axle = np.linalg.norm(np.cross(model.geom_pos[g] - model.jnt_pos[j], model.jnt_axis[j]))
            aligned = model.geom_type[g] == _CYLINDER and abs(axis @ model.jnt_axis[j]) > 0.99
            radius = float(model.geom_size[g, 0])
            if touches and off_axle < 0.05 * radius and (aligned or model.geom_type[g] == _SPHERE):
                found[j] = radius
    return found


def slips(env: Env, recording: Recording) -> Array:
    """The slip ratio of each wheel after each step, shape (k, wheels)."""
    model, _ = require_physics(env)
    rolling = wheels(model)
    if not rolling:
        raise NotMeasuredError("no driven joint turns a wheel")
    ratio, velocity, data = np.zeros((len(recording.qpos), len(rolling))), np.zeros(6), mujoco.MjData(model)
    for k in range(len(ratio)):
        data.qpos[:], data.qvel[:] = recording.qpos[k], recording.qvel[k]
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            compute(model, data)
        for i, (j, radius) in enumerate(rolling.items()):
            body = int(model.jnt_bodyid[j])
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            axle = data.xaxis[j]
            ahead = np.array([axle[1], -axle[0]]) / max(np.hypot(axle[0], axle[1]), 1e-6)
            rate = float(velocity[:3] @ axle)
            ratio[k, i] = slip_ratio(radius * rate, float(ahead @ velocity[3:5]), REGULARIZATION)
    return ratio


def measure(env: Env, recording: Recording) -> Measured:
    """The share of steps in which a wheel slips by more than 0.2."""
    worst = np.abs(slips(env, recording)).max(axis=1)
    evidence = [
        Evidence("95th percentile of the largest slip", float(np.percentile(worst, 95.0)), ""),
        Evidence("largest slip", float(worst.max()), ""),
    ]
    return Measured(float((worst > SLIPS).mean()), evidence)


def treatment(env: Env, recording: Recording) -> Treatment:
    """A slip limiter of these wheels."""
    model, _ = require_physics(env)
    return wrapped(SlipLimiter, wheels=[model.joint(j).name for j in wheels(model)])


SYMPTOM = Symptom("wheels that spin or lock", 0.05, "share", measure, treatment)
