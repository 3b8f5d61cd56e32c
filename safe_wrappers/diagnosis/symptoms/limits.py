"""Unsafe actions near limits: declared costs, joints that press their stops, contacts with what is fixed."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.constraints.limits.joints import JointPositionLimit, driven_joints
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, braking_horizon, physics
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, require_physics
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.model import fixed_bodies
from safe_wrappers.protect import protect, recipe_of
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter

PRESSED = 0.02
"""Share of a joint's range by which it is beyond its stop."""
_GROUND = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


def _costs(recording: Recording) -> NDArray[np.bool_]:
    return np.asarray(np.nan_to_num(recording.of_info("cost")) > 0.0)


def _beyond(env: Env, recording: Recording) -> Array:
    """How far each driven joint with stops is beyond them, as a share of its range, shape (k, joints)."""
    found = physics(env)
    if found is None:
        return np.zeros((len(recording.actions), 0))
    model = found[0]
    joints = _stopped(model)
    low, high = model.jnt_range[joints].T
    position = recording.qpos[:, model.jnt_qposadr[joints]]
    return np.asarray(np.maximum(low - position, position - high) / (high - low))


def _stopped(model: mujoco.MjModel) -> list[int]:
    return [j for j in driven_joints(model) if model.jnt_limited[j]]


def touches_fixed(env: Env, recording: Recording) -> NDArray[np.bool_]:
    """Whether the machine touches something fixed that is no ground, shape (k,)."""
    found = physics(env)
    if found is None:
        return np.zeros(len(recording.actions), dtype=bool)
    model = found[0]
    fixed = fixed_bodies(model)[model.geom_bodyid] & ~np.isin(model.geom_type, _GROUND)
    solid = set(np.flatnonzero(fixed).tolist())
    roots = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in driven_joints(model)}
    machine = {g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] in roots} - solid
    return np.array(
        [any((a in solid and b in machine) or (b in solid and a in machine) for a, b in pairs)
         for pairs in recording.contacts]
    )  # fmt: skip


def measure(env: Env, recording: Recording) -> Measured:
    """The share of steps with a cost, a pressed stop, or a hit."""
    beyond, judged = _beyond(env, recording), not np.isnan(recording.of_info("cost")).all()
    costs, pressed, hits = _costs(recording), (beyond > PRESSED).any(axis=1), touches_fixed(env, recording)
    if not judged and physics(env) is None:
        raise NotMeasuredError(
            "the env reports no cost in info, and has no MuJoCo model whose limits could be read"
        )
    bad = (costs | pressed | hits).astype(float)
    evidence = [
        Evidence("steps with a cost", float(costs.mean()) if judged else np.nan, "share"),
        Evidence("steps with a driven joint pressed beyond its stop", float(pressed.mean()), "share"),
        Evidence("steps in contact with something fixed, not the ground", float(hits.mean()), "share"),
    ]
    if beyond.size:
        model, _ = require_physics(env, "whose limits could be read")
        joints = _stopped(model)
        worst = int(np.argmax(beyond.max(axis=0)))
        speed = float(np.abs(recording.qvel[:, model.jnt_dofadr[joints[worst]]]).max())
        evidence.append(
            Evidence(f"largest speed of {model.joint(joints[worst]).name}", speed, "rad/s or m/s")
        )
    return Measured(float(bad.mean()), bad, evidence)


def is_protected_by_recipe(env: Env) -> bool:
    """Whether `protect` has a recipe for the env, and accepts what is around it."""
    if env.spec is None or recipe_of(env.spec.id) is None:
        return False
    try:
        protect(env)
    except ConfigurationError:
        return False
    return True


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """`protect`, where it knows the env; else limits of the joints that press their stops."""
    if is_protected_by_recipe(env):
        return "env = sw.protect(env)", ""
    found, beyond = physics(env), _beyond(env, recording)
    if found is not None and (beyond > PRESSED).any():
        joints = _stopped(found[0])
        names = [
            found[0].joint(j).name for j, worst in zip(joints, beyond.max(axis=0), strict=True) if worst > 0.0
        ]
        horizon = braking_horizon(recording)
        limit = f"sw.constraints.JointPositionLimit(joints={names}, margin=0.0, horizon={horizon})"
        try:
            CBFActionFilter(env, [JointPositionLimit(joints=names, horizon=horizon)])
            return f"limit = {limit}\nenv = sw.CBFActionFilter(env, [limit])", ""
        except ConfigurationError as error:
            return "", f"JointPositionLimit is refused: {error}"
    if _costs(recording).any():
        return (
            "shield = sw.constraints.PredictiveShield(\"cost\", horizon=20, backup=\"zero\")\n"
            "env = sw.CBFActionFilter(env, [shield], plant=sw.SimulatorPlant())",
            "Choose a backup that stops your machine, and a horizon that is as long as it takes.",
        )  # fmt: skip
    return "", "Say where the fixed things are: Workspace(keep_out=[...]), Clearance or PredictiveShield."


SYMPTOM = Symptom(
    "unsafe actions near obstacles or limits", "section 1.2, barriers and kinetic stopping insets",
    0.02, "share", ("steps with a cost, a pressed stop or a hit", ""), measure, lines,
)  # fmt: skip
