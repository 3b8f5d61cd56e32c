"""diagnose: measure an env's symptoms, rank them, and try what treats them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.checks import whole_number
from safe_wrappers.diagnosis import commands, contacts, limits, wheel_slip
from safe_wrappers.diagnosis.finding import Diagnosis, Finding
from safe_wrappers.diagnosis.recording import (
    Driver,
    Env,
    Recording,
    attacking_driver,
    policy_driver,
    random_driver,
    record,
)
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom
from safe_wrappers.errors import SafeWrappersError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of

SYMPTOMS: Final[dict[str, Symptom]] = {
    "limits": limits.SYMPTOM,
    "command_steps": commands.STEPS,
    "contact_forces": contacts.FORCES,
    "wheel_slip": wheel_slip.SYMPTOM,
    "balance": contacts.BALANCE,
}
"""By name."""
POLICY: Final = "policy"


def diagnose(
    env: Env,
    policy: Any = None,
    steps: int = 2000,
    seed: int = 0,
    symptoms: Sequence[str] | None = None,
) -> Diagnosis:
    """Look for symptoms in an env and a policy, and try the wrapper that each calls for.

    The env is driven at random, by an attacker (random corners of the action space, each held for 15 steps) and by
    the policy. A symptom is ranked by its figure over its threshold: with the policy, or without one for the worse of
    the other two. Where a wrapper treats it, that is put around the env, and the figure is measured again by the same
    driver.

    Args:
        env: With a one-dimensional Box action space. It is stepped and reset, and otherwise left as it is.
        policy: A function of the observation, or a model with `predict(observation, deterministic=True)`. A function
            that has `reset()` is told so where an episode begins.
        steps: Control steps of each driver.
        seed: Of drivers and resets.
        symptoms: Names, of `safe_wrappers.diagnosis.SYMPTOMS`; None looks for all.

    Raises:
        UnsupportedEnvError: No Gymnasium env, or one with other actions.
        UnknownNameError: A symptom of another name.
        ConfigurationError: A policy that is none.
        ActionError: The policy's action has another shape than the env's, or is not finite; the env never gets it.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> found = sw.diagnose(gym.make("SafeRover-v0"), steps=200)
        >>> found.present[0].symptom
        'wheel_slip'
    """
    if not isinstance(env, gym.Env):
        raise UnsupportedEnvError(f"diagnose takes one env, as gym.make returns it; got {env!r}")
    whole_number("steps", steps, 2, "control steps")
    chosen = list(SYMPTOMS) if symptoms is None else list(symptoms)
    for name in chosen:
        if name not in SYMPTOMS:
            raise UnknownNameError(f"no symptom is called {name!r}; there are {', '.join(SYMPTOMS)}")
    drivers = {"random": random_driver(env, seed), "attacking": attacking_driver(env, seed)}
    if policy is not None:
        drivers[POLICY] = policy_driver(policy)
    recordings = {name: record(env, driver, steps, seed) for name, driver in drivers.items()}
    findings = [_found(env, name, recordings, drivers, seed) for name in chosen]
    return Diagnosis(name_of(env), steps, list(drivers), findings)


def _found(
    env: Env, name: str, recordings: dict[str, Recording], drivers: dict[str, Driver], seed: int
) -> Finding:
    """One symptom, with the figure of each driver that says something, and what its wrapper leaves."""
    symptom = SYMPTOMS[name]
    found: dict[str, Measured] = {}
    missing = ""
    if symptom.policies_only and POLICY not in recordings:
        missing = "other drivers say nothing of it: give a policy"
    for driver, recording in recordings.items():
        if symptom.policies_only and driver != POLICY:
            continue
        try:
            found[driver] = symptom.measure(env, recording)
        except NotMeasuredError as error:
            missing = missing or str(error)
    if not found:
        return Finding(name, symptom.title, missing=missing)
    judged = POLICY if POLICY in found else max(found, key=lambda driver: found[driver].figure)
    figure, evidence = found[judged]
    finding = Finding(name, symptom.title, figure, symptom.threshold, symptom.unit, evidence)
    if not finding.present:
        return finding
    makers = {"random": random_driver, "attacking": attacking_driver}
    driver_again = makers[judged](env, seed) if judged in makers else drivers[judged]
    return _treated(env, finding, symptom, recordings[judged], driver_again, seed)


def _treated(
    env: Env, finding: Finding, symptom: Symptom, recording: Recording, driver: Driver, seed: int
) -> Finding:
    """The finding with the figure that its wrapper leaves; one that is refused is told, and why."""
    treatment = symptom.treatment(env, recording)
    told = replace(finding, advice=treatment.advice)
    if treatment.wrap is None:
        return told
    try:
        tried = treatment.wrap(env)
        after = symptom.measure(tried, record(tried, driver, len(recording.infos), seed)).figure
        return replace(told, code=treatment.code, after=after)
    except (SafeWrappersError, NotMeasuredError) as error:
        tool = treatment.code.partition("(")[0].rpartition(".")[2]
        return replace(told, advice=f"{treatment.advice} {tool} was refused: {error}".strip())
