"""Impacts: the peak forces of contacts, against the machine's weight."""

import numpy as np

from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.limits import touches_fixed
from safe_wrappers.diagnosis.recording import Env, Recording, physics
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.model import fixed_bodies, weight_n
from safe_wrappers.protect import protect


def measure(env: Env, recording: Recording) -> Measured:
    """The largest force between two bodies in weights of all that moves."""
    found, forces = physics(env), recording.of_info("contact/peak_force")
    if found is None:
        raise NotMeasuredError("the env has no MuJoCo model whose contacts could be read")
    if np.isnan(forces).all():
        raise NotMeasuredError("no ContactMonitor goes around this env: a step of its outer wrapper is many")
    if not np.isfinite(np.concatenate([recording.qpos.ravel(), forces])).all():
        return Measured(np.inf, forces, [Evidence("steps with numbers that are not finite", 1.0, "")])
    weight = weight_n(found[0])
    deepest = float(np.nanmax(recording.of_info("contact/penetration")))
    peak = float(np.nanmax(forces))
    evidence = [
        Evidence("largest force between two bodies", peak, "N"),
        Evidence("weight of what moves", weight, "N"),
        Evidence("deepest penetration", deepest, "m"),
    ]
    return Measured(peak / weight, forces / weight, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """`protect`, where it keeps the machine off what is fixed; else a limit of the pair that hit hardest."""
    found = physics(env)
    assert found is not None
    if touches_fixed(env, recording).any():
        try:
            protect(env)
            return "env = sw.protect(env)", ""
        except ConfigurationError:
            pass
    model, forces = found[0], np.nan_to_num(recording.of_info("contact/peak_force"), nan=0.0)
    k = int(np.argmax(forces))
    depth = float(recording.of_info("contact/penetration")[k])
    pairs = recording.contacts[k]
    bodies = {tuple(sorted(int(model.geom_bodyid[g]) for g in pair)) for pair in pairs}
    fixed = fixed_bodies(model)
    struck = [(a, b) for a, b in bodies if fixed[a] != fixed[b]]
    if len(struck) != 1 or not depth > 0.0:
        return "", "Limit the speed of what hits: ImpactSpeedLimit, or a lower speed of the whole machine."
    names = [model.body(body).name for body in sorted(struck[0], key=lambda body: bool(fixed[body]))]
    limit = (
        f"limit = sw.constraints.ImpactSpeedLimit(\n    bodies=[{names[0]!r}], against=[{names[1]!r}], "
        f"force_limit={forces[k] / 3.0:.4g}, stiffness={forces[k] / depth:.4g}\n)\n"
    )
    return limit + "env = sw.CBFActionFilter(env, [limit])", ""


SYMPTOM = Symptom(
    "impacts with large forces, or a simulation that diverges", "section 1.5, contact and impact",
    60.0, "weights", ("force between two bodies", "weights"), measure, lines,
)  # fmt: skip
