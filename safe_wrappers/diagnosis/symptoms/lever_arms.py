"""Sensors off the turning axis: what an accelerometer or a velocimeter reads more than the body's turning centre."""

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.dead_reckoning import lever_arm_acceleration
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, replayed, require_physics
from safe_wrappers.plants.mujoco.model import HINGE, SLIDE

_READ = (int(mujoco.mjtSensor.mjSENS_ACCELEROMETER), int(mujoco.mjtSensor.mjSENS_VELOCIMETER))


def _sites(model: mujoco.MjModel) -> list[int]:
    """Of accelerometers and velocimeters on bodies that turn, each once."""
    read = np.isin(model.sensor_type, _READ)
    sites = dict.fromkeys(int(site) for site in model.sensor_objid[read])
    return [site for site in sites if _turning_joint(model, int(model.site_bodyid[site])) >= 0]


def _turning_joint(model: mujoco.MjModel, body: int) -> int:
    """The last joint on the way from the world that turns a body; -1 where none does."""
    while body:
        first = int(model.body_jntadr[body])
        for j in reversed(range(first, first + int(model.body_jntnum[body]))):
            if model.jnt_type[j] != SLIDE:
                return j
        body = int(model.body_parentid[body])
    return -1


def _arm(model: mujoco.MjModel, data: mujoco.MjData, site: int) -> Array:
    """From the turning centre to a site, m: off a hinge's axis, or from the centre of mass of what turns freely."""
    j = _turning_joint(model, int(model.site_bodyid[site]))
    if model.jnt_type[j] == HINGE:
        off = data.site_xpos[site] - data.xanchor[j]
        return np.asarray(off - (off @ data.xaxis[j]) * data.xaxis[j])
    return np.asarray(data.site_xpos[site] - data.subtree_com[model.jnt_bodyid[j]])


def measure(env: Env, recording: Recording) -> Measured:
    """The acceleration that turning adds at the worst sensor, but for one in twenty steps, m/s^2."""
    (model, _), velocity = require_physics(env, "whose sensors could be read"), np.zeros(6)
    sites = _sites(model)
    if not sites:
        raise NotMeasuredError("no accelerometer and no velocimeter sits on a body that turns")
    rates, arms = np.zeros((2, len(recording.qpos), len(sites), 3))
    for k, data in replayed(model, recording):
        for i, site in enumerate(sites):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
            rates[k, i], arms[k, i] = velocity[:3], _arm(model, data, site)
    turning_up = np.diff(rates, axis=0, prepend=rates[:1]) / recording.control_dt
    turning_up[recording.first] = 0.0
    added = np.linalg.norm(lever_arm_acceleration(np.zeros_like(rates), rates, turning_up, arms), axis=2)
    worst = int(np.argmax(np.percentile(added, 95.0, axis=0)))
    speeds = np.linalg.norm(np.cross(rates[:, worst], arms[:, worst]), axis=1)
    evidence = [
        Evidence(
            f"lever arm of {model.site(sites[worst]).name}",
            float(np.linalg.norm(arms[:, worst], axis=1).max()),
            "m",
        ),
        Evidence(
            "turn rate, 95th percentile",
            float(np.percentile(np.linalg.norm(rates[:, worst], axis=1), 95.0)),
            "rad/s",
        ),
        Evidence("speed that turning adds, 95th percentile", float(np.percentile(speeds, 95.0)), "m/s"),
    ]
    return Measured(float(np.percentile(added[:, worst], 95.0)), added[:, worst], evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """No wrapper moves a sensor: it is told which one knows of lever arms."""
    return "", (
        "Take the lever arm out before readings are used as the body's own: OcclusionPenalty with a Sensor whose "
        "Imu(site=..., lever_arm=True) does so; safe_wrappers.control.estimation.dead_reckoning has the formula."
    )


SYMPTOM = Symptom(
    "sensors off the turning axis", "section 1.4.3, lever-arm acceleration",
    1.0, "m/s^2", ("acceleration that turning adds", "m/s^2"), measure, lines,
)  # fmt: skip
