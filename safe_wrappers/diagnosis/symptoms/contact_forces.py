"""Impacts: the peak forces of contacts, against the machine's weight."""

import numpy as np

from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import NOT_REPLAYED, Env, Recording, braking_horizon
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, require_physics
from safe_wrappers.diagnosis.symptoms.limits import is_protected_by_recipe, touches_fixed
from safe_wrappers.plants.mujoco.model import fixed_bodies, weight_n


def measure(env: Env, recording: Recording) -> Measured:
    """The largest force between two bodies above the usual one, in weights of all that moves."""
    model, _ = require_physics(env, "whose contacts could be read")
    forces = recording.of_info("contact/peak_force")
    if np.isnan(forces).all():
        raise NotMeasuredError("no ContactMonitor goes around this env: a step of its outer wrapper is many")
    bad = recording.diverged | ~np.isfinite(np.column_stack([recording.qpos, recording.qvel])).all(axis=1)
    if bad.any():
        return Measured(
            np.inf,
            bad.astype(float),
            [Evidence("steps in which the simulation diverged", float(bad.sum()), "")],
        )
    if recording.of_info("contact/partial").mean() > 0.5:
        raise NotMeasuredError(NOT_REPLAYED)
    weight = weight_n(model)
    deepest = float(np.nanmax(recording.of_info("contact/penetration")))
    # What presses all the time, maybe where it cannot move, is no impact.
    impacts = np.maximum(forces - np.nanmedian(forces), 0.0)
    peak = float(np.nanmax(impacts))
    evidence = [
        Evidence("largest force between two bodies, above the usual one", peak, "N"),
        Evidence("weight of what moves", weight, "N"),
        Evidence("deepest penetration", deepest, "m"),
    ]
    return Measured(peak / weight, impacts / weight, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """`protect`, where it keeps the machine off what is fixed; else a limit of the pair that hit hardest."""
    if recording.diverged.any():
        return "", "The simulation diverged: a shorter timestep, softer contacts, or weaker actuators."
    if touches_fixed(env, recording).any() and is_protected_by_recipe(env):
        return "env = sw.protect(env)", ""
    forces = np.nan_to_num(recording.of_info("contact/peak_force"), nan=0.0)
    k = int(np.argmax(forces))
    depth, pair = float(recording.of_info("contact/penetration")[k]), recording.struck[k]
    if pair is None or not depth > 0.0:
        return "", "Limit the speed of what hits: ImpactSpeedLimit, or a lower speed of the whole machine."
    model, _ = require_physics(env, "whose contacts could be read")
    fixed = fixed_bodies(model)
    names = sorted(pair, key=lambda name: bool(fixed[model.body(name).id]))
    limit = (
        f"limit = sw.constraints.ImpactSpeedLimit(\n    bodies=[{names[0]!r}], against=[{names[1]!r}], "
        f"force_limit={forces[k] / 3.0:.4g}, stiffness={forces[k] / depth:.4g}, "
        f"horizon={braking_horizon(recording)}\n)\n"
    )
    return limit + "env = sw.CBFActionFilter(env, [limit])", ""


SYMPTOM = Symptom(
    "impacts with large forces, or a simulation that diverges", "section 1.5, contact and impact",
    60.0, "weights", ("force between two bodies", "weights"), measure, lines,
)  # fmt: skip
