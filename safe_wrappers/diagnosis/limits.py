"""Unsafe actions near limits: declared costs, joints that press their stops, contacts with what is fixed."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.constraints import JointPositionLimit, PredictiveShield
from safe_wrappers.constraints.limits.joints import driven_joints
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, braking_horizon, physics
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, Treatment, filtered, wrapped
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants import SimulatorPlant
from safe_wrappers.plants.mujoco.model import fixed_bodies
from safe_wrappers.protect import protect, recipe_of
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter

PRESSED = 0.02
"""Share of a joint's range by which it is beyond its stop."""
_GROUND = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


def _beyond(env: Env, recording: Recording) -> tuple[list[str], Array]:
    """Driven joints with stops, and how far each is beyond them, as a share of its range, shape (k, joints)."""
    found = physics(env)
    if found is None:
        return [], np.zeros((len(recording.first), 0))
    model = found[0]
    joints = [j for j in driven_joints(model) if model.jnt_limited[j]]
    low, high = model.jnt_range[joints].T
    position = recording.qpos[:, model.jnt_qposadr[joints]]
    return [model.joint(j).name for j in joints], np.maximum(low - position, position - high) / (high - low)


def touches_fixed(env: Env, recording: Recording) -> NDArray[np.bool_]:
    """Whether the machine touches something fixed that is no ground, shape (k,)."""
    found = physics(env)
    if found is None:
        return np.zeros(len(recording.first), dtype=bool)
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
    cost = recording.of_info("cost")
    judged = not np.isnan(cost).all()
    if not judged and physics(env) is None:
        raise NotMeasuredError(
            "the env reports no cost in info, and has no MuJoCo model whose limits could be read"
        )
    beyond = _beyond(env, recording)[1]
    costs, pressed, hits = cost > 0.0, (beyond > PRESSED).any(axis=1), touches_fixed(env, recording)
    evidence = [
        Evidence("steps with a cost", float(costs.mean()) if judged else np.nan, "share"),
        Evidence("steps with a driven joint pressed beyond its stop", float(pressed.mean()), "share"),
        Evidence("steps in contact with something fixed, not the ground", float(hits.mean()), "share"),
    ]
    return Measured(float((costs | pressed | hits).mean()), evidence)


def is_protected_by_recipe(env: Env) -> bool:
    """Whether `protect` has a recipe for the env, and accepts what is around it."""
    if env.spec is None or recipe_of(env.spec.id) is None:
        return False
    try:
        protect(env)
    except ConfigurationError:
        return False
    return True


def treatment(env: Env, recording: Recording) -> Treatment:
    """`protect`, where it knows the env; else limits of joints that press their stops, or a forecast of the cost."""
    if is_protected_by_recipe(env):
        return wrapped(protect)
    names, beyond = _beyond(env, recording)
    pressed = [
        name for name, worst in zip(names, beyond.max(axis=0, initial=0.0), strict=True) if worst > 0.0
    ]
    if (beyond > PRESSED).any():
        return filtered(JointPositionLimit, joints=pressed, margin=0.0, horizon=braking_horizon(recording))
    if (recording.of_info("cost") > 0.0).any():
        return Treatment(
            'limit = sw.constraints.PredictiveShield("cost", horizon=20, backup="zero")\n'
            "env = sw.CBFActionFilter(env, [limit], plant=sw.SimulatorPlant())",
            _shielded,
            "Choose a backup that stops your machine, and a horizon that is as long as it takes.",
        )
    return Treatment(
        advice="Say where the fixed things are: Workspace(keep_out=[...]), Clearance or PredictiveShield."
    )


def _shielded(env: Env) -> Env:
    limit = PredictiveShield("cost", horizon=20, backup="zero")
    return CBFActionFilter(env, [limit], plant=SimulatorPlant())


SYMPTOM = Symptom("unsafe actions near obstacles or limits", 0.02, "share", measure, treatment)
