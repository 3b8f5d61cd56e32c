"""Balance: friction that is used up, and a zero moment point that leaves the support."""

import numpy as np

from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import NOT_REPLAYED, Env, Recording, physics
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom
from safe_wrappers.diagnosis.symptoms.wheel_slip import wheels
from safe_wrappers.plants.env_checks import name_of


def measure(env: Env, recording: Recording) -> Measured:
    """The share of steps with a foot at the edge of its friction cone, or outside of the support polygon."""
    found = physics(env)
    if found is not None and wheels(found[0]):
        raise NotMeasuredError("it rolls: its wheels are judged by their slip")
    friction, zmp = recording.of_info("balance/friction_used"), recording.of_info("balance/zmp_margin")
    if np.isnan(friction).all():
        raise NotMeasuredError(
            "no BalanceMonitor goes around this env: nothing stands on fixed ground by friction"
        )
    if recording.of_info("balance/partial").mean() > 0.5:
        raise NotMeasuredError(NOT_REPLAYED)
    if np.nanmax(recording.of_info("balance/airborne")) == 0.0 and not recording.terminated.any():
        raise NotMeasuredError(f"{name_of(env)} never left the ground: it does not balance")
    sliding, tipping = friction >= 1.0, zmp < 0.0
    bad = (sliding | tipping).astype(float)
    evidence = [
        Evidence("steps with a contact at the edge of its friction cone", float(sliding.mean()), "share"),
        Evidence("steps with the zero moment point outside the support", float(tipping.mean()), "share"),
        Evidence("falls per 1,000 steps", 1e3 * float(recording.terminated.mean()), ""),
    ]
    return Measured(float(bad.mean()), bad, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """The filter that forecasts contact forces."""
    return "env = sw.WholeBodyFilter(env, joint_tolerance=None)", ""


SYMPTOM = Symptom(
    "feet that slide or tip", "section 1.7, centroidal momentum and contact feasibility",
    0.05, "share", ("sliding or tipping", ""), measure, lines, policies_only=True,
)  # fmt: skip
