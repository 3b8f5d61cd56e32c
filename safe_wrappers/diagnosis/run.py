"""diagnose: measure an env's symptoms, rank them, and try what treats them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import gymnasium as gym
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import whole_number
from safe_wrappers.diagnosis.finding import Diagnosis, Finding, Series
from safe_wrappers.diagnosis.recording import (
    Driver,
    Env,
    Predicts,
    attacking_driver,
    policy_driver,
    random_driver,
    record,
)
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Recordings, Symptom
from safe_wrappers.diagnosis.symptoms import (
    balance,
    command_steps,
    contact_forces,
    late_commands,
    lever_arms,
    limits,
    loop_margin,
    port_energy,
    singular_poses,
    soft_joints,
    unobserved_states,
    wheel_slip,
)
from safe_wrappers.errors import ConfigurationError, SafeWrappersError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.wrappers.cbf_action_filter import filter_inside

SYMPTOMS: Final[dict[str, Symptom]] = {
    "limits": limits.SYMPTOM,
    "command_steps": command_steps.SYMPTOM,
    "late_commands": late_commands.SYMPTOM,
    "singular_poses": singular_poses.SYMPTOM,
    "lever_arms": lever_arms.SYMPTOM,
    "loop_margin": loop_margin.SYMPTOM,
    "contact_forces": contact_forces.SYMPTOM,
    "wheel_slip": wheel_slip.SYMPTOM,
    "balance": balance.SYMPTOM,
    "port_energy": port_energy.SYMPTOM,
    "soft_joints": soft_joints.SYMPTOM,
    "unobserved_states": unobserved_states.SYMPTOM,
}
"""By name."""
POLICY: Final = "policy"


def diagnose(
    env: Env,
    policy: Predicts | Driver | None = None,
    steps: int = 2000,
    seed: int = 0,
    symptoms: Sequence[str] | None = None,
) -> Diagnosis:
    """Look for the symptoms of the appendix's first table, and try the wrapper that each calls for.

    The env is driven at random, by an attacker (random corners of the action space, each held for 15 steps) and by
    the policy. A symptom is ranked by its figure over its threshold: with the policy, or without one for the worse of
    the other two. Where lines of code treat it, they are run around the env, and the figure is measured again by the
    same drivers.

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
        ConfigurationError: A policy that is none, or whose actions do not fit the env.

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
        _try(env, drivers[POLICY])
    recordings = {name: record(env, driver, steps, seed) for name, driver in drivers.items()}
    findings = []
    for name in chosen:
        finding = _found(env, name, recordings)
        if finding.present and finding.code:
            finding = _treated(env, finding, drivers, steps, seed)
        findings.append(finding)
    return Diagnosis(name_of(env), steps, list(drivers), findings, _idle_constraints(env, recordings))


def _try(env: Env, driver: Driver) -> None:
    """Ask a policy once, so that one of another env is told before the first run."""
    observation, _ = env.reset(seed=0)
    space: Any = env.action_space
    try:
        action = np.asarray(driver(observation))
    except Exception as error:
        raise ConfigurationError(
            f"the policy raised {type(error).__name__} for an observation of {name_of(env)}: {error}. "
            "Is it this env's?"
        ) from error
    if action.shape != space.shape:
        raise ConfigurationError(
            f"the policy gives actions of shape {action.shape}, {name_of(env)} takes {space.shape}. Is it this env's?"
        )


def _idle_constraints(env: Env, recordings: Recordings) -> list[str]:
    """The constraints of the env's filter, if it has one, that have refused nothing."""
    inside = filter_inside(env)
    if inside is None:
        return []
    infos = [info for recording in recordings.values() for info in recording.infos]
    acted = np.any([info[keys.CBF_REFUSED] for info in infos if keys.CBF_REFUSED in info], axis=0)
    return [name for name, has in zip(inside.constraint_names, acted, strict=True) if not has]


def _measured(env: Env, symptom: Symptom, recordings: Recordings) -> tuple[dict[str, Measured], str]:
    """Of each driver that says something, and why the others do not."""
    found, missing = {}, ""
    for driver, recording in recordings.items():
        if symptom.policies_only and driver != POLICY:
            continue
        try:
            found[driver] = symptom.measure(env, recording)
        except NotMeasuredError as error:
            missing = missing or str(error)
    if symptom.policies_only and POLICY not in recordings:
        missing = "other drivers say nothing of it: give a policy"
    return found, missing


def _judged(found: dict[str, Measured], least: bool) -> str:
    """The driver whose figure counts: the policy, or else the worse of the others, or the milder."""
    choose = min if least else max
    return POLICY if POLICY in found else choose(found, key=lambda driver: found[driver].figure)


def _found(env: Env, name: str, recordings: Recordings) -> Finding:
    symptom = SYMPTOMS[name]
    found, missing = _measured(env, symptom, recordings)
    if not found:
        return Finding(name, symptom.title, symptom.section, missing=missing)
    driver = _judged(found, symptom.least)
    measured = found[driver]
    code = advice = ""
    if measured.figure >= symptom.threshold:
        code, advice = symptom.lines(env, recordings[driver])
    return Finding(
        name, symptom.title, symptom.section, measured.figure, symptom.threshold, symptom.unit,
        {each: one.figure for each, one in found.items()}, measured.evidence, code, advice,
        series=Series(*symptom.plotted, driver, measured.steps),
    )  # fmt: skip


def _as_before(tried: Env, env: Env) -> Env:
    """What a policy of the env alone can be asked in: a flat observation that has grown loses what is new."""
    new, old = tried.observation_space, env.observation_space
    if not isinstance(new, gym.spaces.Box) or not isinstance(old, gym.spaces.Box) or len(new.shape) != 1:
        return tried
    if new.shape[0] <= old.shape[0]:
        return tried
    return gym.wrappers.TransformObservation(tried, lambda seen: seen[: old.shape[0]], old)


def _treated(env: Env, finding: Finding, drivers: dict[str, Driver], steps: int, seed: int) -> Finding:
    """The finding with the figure that its lines leave; lines that are refused are taken out, and it is told why."""
    import safe_wrappers

    scope: dict[str, Any] = {"env": env, "sw": safe_wrappers}
    assert finding.series is not None
    driver = finding.series.driver
    makers = {"random": random_driver, "attacking": attacking_driver}
    try:
        exec(finding.code, scope)  # the very lines that the user is told
        fresh = makers[driver](env, seed) if driver in makers else drivers[driver]
        recording = record(_as_before(scope["env"], env), fresh, steps, seed)
        return replace(finding, after=SYMPTOMS[finding.symptom].measure(scope["env"], recording).figure)
    except (SafeWrappersError, NotMeasuredError) as error:
        tool = f"{finding.advice} {finding.code.partition('(')[0].rpartition('sw.')[2]} was refused: {error}"
        return replace(finding, code="", advice=tool.strip())
