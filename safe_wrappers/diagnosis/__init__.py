"""From symptom to tool: what is wrong with an env and a policy, and which wrapper treats it."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.diagnosis.recording import (
    Driver,
    Env,
    NotMeasuredError,
    Recording,
    attacking_driver,
    policy_driver,
    random_driver,
    record,
)
from safe_wrappers.diagnosis.symptoms import SYMPTOMS
from safe_wrappers.errors import SafeWrappersError, UnknownNameError, UnsupportedEnvError, whole_number
from safe_wrappers.plants.env_checks import name_of

__all__ = ["SYMPTOMS", "Diagnosis", "Finding", "diagnose"]

POLICY: Final = "policy"


@dataclass(frozen=True)
class Finding:
    """One symptom in one env.

    Attributes:
        symptom: Its name, a key of `SYMPTOMS`.
        title: In words.
        figure: What was measured, in `unit`: with the policy, or without one for the worse of the other drivers; NaN
            where it could not be measured.
        threshold: From which on it is a symptom.
        unit: Of both.
        code: Lines that put the wrapper that was tried around `env`; "" where none was.
        advice: What to do besides, or why no wrapper was tried.
        after: The figure in a second run with that wrapper, of the same driver; NaN where there was none.
        missing: Why it could not be measured; "" where it was.
    """

    symptom: str
    title: str
    figure: float = math.nan
    threshold: float = math.nan
    unit: str = ""
    code: str = ""
    advice: str = ""
    after: float = math.nan
    missing: str = ""

    @property
    def severity(self) -> float:
        """The figure in thresholds; NaN where it was not measured."""
        return self.figure / self.threshold

    @property
    def present(self) -> bool:
        """Whether the symptom is there."""
        return self.severity >= 1.0

    def lines(self) -> list[str]:
        """For a terminal: the verdict, and of a symptom that is there the lines to paste."""
        limit, figure = _amount(self.threshold, self.unit), _amount(self.figure, self.unit)
        words = self.missing or f"{self.title}: {figure} (a symptom from {limit} on)"
        verdict = "unknown" if self.missing else "FOUND" if self.present else "not found"
        lines = [f"  {verdict:9} {self.symptom:17} {words}"]
        if self.present:
            if self.code:
                lines += [f"      {line}" for line in self.code.splitlines()]
                lines.append(f"      with these lines: {_amount(self.after, self.unit)}")
            if self.advice:
                lines.append(f"      {self.advice}")
        return lines


def _amount(value: float, unit: str) -> str:
    """A number with its unit, for people."""
    if math.isnan(value):
        return "not measured"
    return f"{100.0 * value:.3g} %" if unit == "share" else f"{value:.3g} {unit}".strip()


@dataclass(frozen=True)
class Diagnosis:
    """Findings, the most severe first, then what is not there, then what could not be measured.

    Attributes:
        env: Id of the env, or its name.
        steps: Control steps of each driver.
        drivers: Names.
        findings: One per symptom.
    """

    env: str
    steps: int
    drivers: Sequence[str]
    findings: Sequence[Finding]

    def __post_init__(self) -> None:
        ranked = sorted(
            self.findings, key=lambda one: -math.inf if one.missing else one.severity, reverse=True
        )
        object.__setattr__(self, "findings", ranked)

    @property
    def present(self) -> list[Finding]:
        """The symptoms that are there, the most severe first."""
        return [finding for finding in self.findings if finding.present]

    def finding(self, symptom: str) -> Finding:
        """That of one symptom; `KeyError` where it was not looked for."""
        return {finding.symptom: finding for finding in self.findings}[symptom]

    def as_json(self) -> str:
        """All of it; null for numbers that are not finite."""
        whole = asdict(self)
        for finding, plain in zip(self.findings, whole["findings"], strict=True):
            plain.update(severity=finding.severity, present=finding.present)
        finite = json.loads(json.dumps(whole), parse_constant=lambda not_finite: None)
        return json.dumps(finite, indent=1) + "\n"

    def __str__(self) -> str:
        """A table for a terminal, and the lines to paste."""
        head = f"{self.env}: {self.steps:,} steps each of {', '.join(self.drivers)}"
        return "\n".join([head, *(line for finding in self.findings for line in finding.lines())])


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
    makers: dict[str, Callable[[], Driver]] = {
        "random": lambda: random_driver(env, seed),
        "attacking": lambda: attacking_driver(env, seed),
    }
    if policy is not None:
        driver = policy_driver(policy)
        makers[POLICY] = lambda: driver
    recordings = {name: record(env, make(), steps, seed) for name, make in makers.items()}
    findings = []
    for name in chosen:
        finding, judged = _found(name, recordings)
        if finding.present:
            finding = _treated(finding, recordings[judged], makers[judged](), seed)
        findings.append(finding)
    return Diagnosis(name_of(env), steps, list(makers), findings)


def _found(name: str, recordings: dict[str, Recording]) -> tuple[Finding, str]:
    """One symptom, and the driver by which it is judged."""
    symptom, figures, missing = SYMPTOMS[name], dict[str, float](), ""
    drivers = [POLICY] if symptom.policies_only else list(recordings)
    for driver in drivers:
        try:
            figures[driver] = symptom.measure(recordings[driver])
        except KeyError:
            missing = "other drivers say nothing of it: give a policy"
        except NotMeasuredError as error:
            missing = str(error)
    if not figures:
        return Finding(name, symptom.title, missing=missing), ""
    judged = POLICY if POLICY in figures else max(figures, key=figures.__getitem__)
    return Finding(name, symptom.title, figures[judged], symptom.threshold, symptom.unit), judged


def _treated(finding: Finding, recording: Recording, driver: Driver, seed: int) -> Finding:
    """The finding with the figure that its wrapper leaves; one that is refused is told, and why."""
    symptom = SYMPTOMS[finding.symptom]
    try:
        treatment = symptom.treatment(recording)
        finding = replace(finding, advice=treatment.advice)
        if treatment.wrap is None:
            return finding
        tried = treatment.wrap(recording.env)
        after = symptom.measure(record(tried, driver, len(recording.infos), seed))
        return replace(finding, code=treatment.code, after=after)
    except (SafeWrappersError, NotMeasuredError) as error:
        return replace(finding, advice=f"{finding.advice} What treats it was refused: {error}".strip())
