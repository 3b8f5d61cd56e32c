"""What a diagnosis says: findings with their evidence, ranked."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple


class Evidence(NamedTuple):
    """One measured number."""

    name: str
    value: float
    unit: str


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
        evidence: Further numbers.
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
    evidence: Sequence[Evidence] = ()
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


def _finite(value: Any) -> Any:
    """The same with None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
            evidence = [each._asdict() for each in finding.evidence]
            plain.update(evidence=evidence, severity=finding.severity, present=finding.present)
        return json.dumps(_finite(whole), indent=1, allow_nan=False) + "\n"

    def __str__(self) -> str:
        """A table for a terminal, and the lines to paste."""
        lines = [f"{self.env}: {self.steps:,} steps each of {', '.join(self.drivers)}"]
        for finding in self.findings:
            verdict = "unknown" if finding.missing else "FOUND" if finding.present else "not found"
            lines.append(f"  {verdict:9} {finding.symptom:17} {_words(finding)}")
            if not finding.present:
                continue
            lines += [f"      - {each.name}: {amount(each.value, each.unit)}" for each in finding.evidence]
            if finding.code:
                lines += [f"      {line}" for line in finding.code.splitlines()]
                lines.append(f"      with these lines: {amount(finding.after, finding.unit)}")
            if finding.advice:
                lines.append(f"      {finding.advice}")
        return "\n".join(lines)


def _words(finding: Finding) -> str:
    if finding.missing:
        return finding.missing
    limit = amount(finding.threshold, finding.unit)
    return f"{finding.title}: {amount(finding.figure, finding.unit)} (a symptom from {limit} on)"


def amount(value: float, unit: str) -> str:
    """A number with its unit, for people."""
    if math.isnan(value):
        return "not measured"
    return f"{100.0 * value:.3g} %" if unit == "share" else f"{value:.3g} {unit}".strip()
