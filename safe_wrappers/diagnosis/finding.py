"""What a diagnosis says: findings with their evidence, ranked."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from safe_wrappers.checks import Array
from safe_wrappers.errors import UnknownNameError


class Evidence(NamedTuple):
    """One measured number."""

    name: str
    value: float
    unit: str


class Series(NamedTuple):
    """What a plot shows: a number of every control step of one driver."""

    name: str
    unit: str
    driver: str
    values: Array


@dataclass(frozen=True)
class Finding:
    """One symptom in one env.

    Attributes:
        symptom: Its name, a key of `SYMPTOMS`.
        title: In words.
        section: Of the appendix.
        figure: What was measured, in `unit`: with the policy, or without one the worse of the other drivers (the
            milder for `Symptom.least`); NaN where it could not be measured.
        threshold: From which on it is a symptom.
        unit: Of both.
        by_driver: The figure of each driver.
        evidence: Further numbers.
        code: Lines that put a wrapper around `env`, tried in a second run; "" where there are none.
        advice: What to do besides, or why there are no lines.
        after: The figure in the second run, of the same drivers; NaN where there was none.
        missing: Why it could not be measured; "" where it was.
        series: For a plot.
    """

    symptom: str
    title: str
    section: str
    figure: float = math.nan
    threshold: float = math.nan
    unit: str = ""
    by_driver: Mapping[str, float] = field(default_factory=dict)
    evidence: Sequence[Evidence] = ()
    code: str = ""
    advice: str = ""
    after: float = math.nan
    missing: str = ""
    series: Series | None = None

    @property
    def severity(self) -> float:
        """The figure in thresholds; NaN where it was not measured."""
        return self.figure / self.threshold

    @property
    def present(self) -> bool:
        """Whether the symptom is there."""
        return self.severity >= 1.0

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and words; None for what was not measured."""
        numbers = {
            name: _number(getattr(self, name)) for name in ("figure", "threshold", "severity", "after")
        }
        words = {
            name: getattr(self, name) for name in ("symptom", "title", "section", "unit", "code", "advice")
        }
        return {
            **words,
            **numbers,
            "present": self.present,
            "missing": self.missing,
            "by_driver": {driver: _number(value) for driver, value in self.by_driver.items()},
            "evidence": [{**one._asdict(), "value": _number(one.value)} for one in self.evidence],
        }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class Diagnosis:
    """Findings, the most severe first, then what is not there, then what could not be measured.

    Attributes:
        env: Id of the env, or its name.
        steps: Control steps of each driver.
        drivers: Names.
        findings: One per symptom.
        idle_constraints: Those of the env's filter that have refused no action of any driver, by name.
    """

    env: str
    steps: int
    drivers: Sequence[str]
    findings: Sequence[Finding]
    idle_constraints: Sequence[str] = ()

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
        """That of one symptom."""
        found = {finding.symptom: finding for finding in self.findings}
        if symptom not in found:
            raise UnknownNameError(f"no symptom {symptom!r} was looked for; there are {', '.join(found)}")
        return found[symptom]

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {
            "env": self.env,
            "steps": self.steps,
            "drivers": list(self.drivers),
            "idle_constraints": list(self.idle_constraints),
            "findings": [finding.as_dict() for finding in self.findings],
        }

    def as_json(self) -> str:
        """All of it."""
        return json.dumps(self.as_dict(), indent=1, allow_nan=False) + "\n"

    @property
    def idle_words(self) -> str:
        """What to think of constraints that have refused nothing; "" where each has."""
        if not self.idle_constraints:
            return ""
        names = ", ".join(self.idle_constraints)
        may_be = "A limit may be out of reach, or in another unit; angles are in rad."
        return f"Never acted, with any driver: {names}. {may_be}"

    def __str__(self) -> str:
        """A table for a terminal, and the lines to paste."""
        lines = [f"{self.env}: {self.steps:,} steps each of {', '.join(self.drivers)}"]
        if self.idle_constraints:
            lines.append(f"  {self.idle_words}")
        for finding in self.findings:
            lines.append(f"  {_verdict(finding):9} {finding.symptom:16} {_words(finding)}")
            if finding.present and finding.code:
                lines += [f"      {line}" for line in finding.code.splitlines()]
                lines.append(f"      with these lines: {amount(finding.after, finding.unit)}")
            if finding.present and finding.advice:
                lines.append(f"      {finding.advice}")
        return "\n".join(lines)


def _verdict(finding: Finding) -> str:
    return "unknown" if finding.missing else "FOUND" if finding.present else "not found"


def _words(finding: Finding) -> str:
    if finding.missing:
        return finding.missing
    limit = amount(finding.threshold, finding.unit)
    return f"{finding.title}: {amount(finding.figure, finding.unit)} (from {limit} on; {finding.section})"


def amount(value: float, unit: str) -> str:
    """A number with its unit, for people."""
    if math.isnan(value):
        return "not measured"
    return f"{100.0 * value:.3g} %" if unit == "share" else f"{value:.3g} {unit}".strip()
