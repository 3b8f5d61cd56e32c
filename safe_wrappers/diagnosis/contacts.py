"""Contacts: peak forces against the machine's weight; and feet that slide or tip."""

import numpy as np

from safe_wrappers.constraints import ImpactSpeedLimit
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.limits import is_protected_by_recipe, touches_fixed
from safe_wrappers.diagnosis.recording import Env, Recording, braking_horizon, physics
from safe_wrappers.diagnosis.symptom import (
    Measured,
    NotMeasuredError,
    Symptom,
    Treatment,
    filtered,
    require_physics,
    wrapped,
)
from safe_wrappers.diagnosis.wheel_slip import wheels
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.mujoco.model import fixed_bodies, weight_n
from safe_wrappers.protect import protect
from safe_wrappers.wrappers.presets import WholeBodyFilter


def measure_forces(env: Env, recording: Recording) -> Measured:
    """The largest force between two bodies above the usual one, in weights of all that moves."""
    model, _ = require_physics(env)
    forces = recording.of_info("contact/peak_force")
    if np.isnan(forces).all():
        raise NotMeasuredError("no ContactMonitor goes around this env: a step of its outer wrapper is many")
    bad = recording.diverged | ~np.isfinite(np.column_stack([recording.qpos, recording.qvel])).all(axis=1)
    if bad.any():
        return Measured(np.inf, [Evidence("steps in which the simulation diverged", float(bad.sum()), "")])
    if recording.not_replayed:
        raise NotMeasuredError(recording.not_replayed)
    # What presses all the time, maybe where it cannot move, is no impact.
    peak = max(float(np.nanmax(forces) - np.nanmedian(forces)), 0.0)
    evidence = [
        Evidence("largest force between two bodies, above the usual one", peak, "N"),
        Evidence("weight of what moves", weight_n(model), "N"),
        Evidence("deepest penetration", float(np.nanmax(recording.of_info("contact/penetration"))), "m"),
    ]
    return Measured(peak / weight_n(model), evidence)


def treatment_of_impacts(env: Env, recording: Recording) -> Treatment:
    """`protect`, where it keeps the machine off what is fixed; else a limit of the pair that hit hardest."""
    if recording.diverged.any():
        return Treatment(
            advice="The simulation diverged: a shorter timestep, softer contacts, or weaker actuators."
        )
    if touches_fixed(env, recording).any() and is_protected_by_recipe(env):
        return wrapped(protect)
    forces = np.nan_to_num(recording.of_info("contact/peak_force"), nan=0.0)
    k = int(np.argmax(forces))
    depth, pair = float(recording.of_info("contact/penetration")[k]), recording.struck[k]
    if pair is None or not depth > 0.0:
        return Treatment(
            advice="Limit the speed of what hits: ImpactSpeedLimit, or a lower speed of the whole machine."
        )
    model, _ = require_physics(env)
    fixed = fixed_bodies(model)
    names = sorted(pair, key=lambda name: bool(fixed[model.body(name).id]))
    return filtered(
        ImpactSpeedLimit,
        bodies=names[:1],
        against=names[1:],
        force_limit=float(f"{forces[k] / 3.0:.4g}"),
        stiffness=float(f"{forces[k] / depth:.4g}"),
        horizon=braking_horizon(recording),
    )


def measure_balance(env: Env, recording: Recording) -> Measured:
    """The share of steps with a foot at the edge of its friction cone, or outside of the support polygon."""
    found = physics(env)
    if found is not None and wheels(found[0]):
        raise NotMeasuredError("it rolls: its wheels are judged by their slip")
    friction, zmp = recording.of_info("balance/friction_used"), recording.of_info("balance/zmp_margin")
    if np.isnan(friction).all():
        raise NotMeasuredError(
            "no BalanceMonitor goes around this env: nothing stands on fixed ground by friction"
        )
    if recording.not_replayed:
        raise NotMeasuredError(recording.not_replayed)
    if not ((friction == 0.0).any() or recording.terminated.any()):
        raise NotMeasuredError(f"{name_of(env)} never left the ground: it does not balance")
    sliding, tipping = friction >= 1.0, zmp < 0.0
    evidence = [
        Evidence("steps with a contact at the edge of its friction cone", float(sliding.mean()), "share"),
        Evidence("steps with the zero moment point outside the support", float(tipping.mean()), "share"),
        Evidence("falls per 1,000 steps", 1e3 * float(recording.terminated.mean()), ""),
    ]
    return Measured(float((sliding | tipping).mean()), evidence)


def treatment_of_feet(env: Env, recording: Recording) -> Treatment:
    """The filter that forecasts contact forces."""
    return wrapped(WholeBodyFilter, joint_tolerance=None)


FORCES = Symptom(
    "impacts with large forces, or a simulation that diverges",
    60.0,
    "weights",
    measure_forces,
    treatment_of_impacts,
)
BALANCE = Symptom(
    "feet that slide or tip", 0.05, "share", measure_balance, treatment_of_feet, policies_only=True
)
