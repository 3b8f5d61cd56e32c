"""A diagnosis as an HTML page: each symptom with its evidence, a plot, and the lines that treat it."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from safe_wrappers.diagnosis import Diagnosis, Finding
from safe_wrappers.diagnosis.finding import amount

from ..figures.canvas import BAD, arm_color, draw
from ..figures.picture import Picture, Plotted
from ..figures.plot_files import PlotFiles
from ..report.markup import document, pictures, section, text


def diagnosis_page(diagnosis: Diagnosis, command: str, files: PlotFiles) -> str:
    """The whole page; `files` gets what its plots are drawn from."""
    there = diagnosis.present
    verdict = (
        f"{len(there)} symptom(s), {there[0].title} first."
        if there
        else "No symptom was found among those that could be measured."
    )
    drivers = ", ".join(diagnosis.drivers)
    head = (
        f"<header><h1>{text(diagnosis.env)}</h1><p>{diagnosis.steps:,} control steps each of the drivers: "
        f'{text(drivers)}.</p></header><p class="verdict">{text(verdict)}</p>'
        + (f"<p>{text(diagnosis.idle_words)}</p>" if diagnosis.idle_words else "")
    )
    found = [section(finding.title, *_parts(finding, files)) for finding in there]
    rest = [finding for finding in diagnosis.findings if not finding.present]
    rows = "".join(f"<tr><td>{text(one.title)}</td><td>{text(_why_not(one))}</td></tr>" for one in rest)
    table = f'<table class="words"><tbody>{rows}</tbody></table>'
    others = section("Not found, or not measured", table) if rest else ""
    made = section("This page", f"<pre>{text(command)}</pre>")
    return document(f"Diagnosis of {diagnosis.env}", "\n".join([head, *found, others, made]))


def _parts(finding: Finding, files: PlotFiles) -> list[str]:
    of_drivers = [(f"{driver} driver" if driver != "policy" else "the policy", value, finding.unit)
                  for driver, value in finding.by_driver.items()]  # fmt: skip
    numbers = [*of_drivers, *finding.evidence]
    rows = "".join(
        f"<tr><td>{text(name)}</td><td>{text(amount(value, unit))}</td></tr>" for name, value, unit in numbers
    )
    parts = [
        f"<p>A symptom from {text(amount(finding.threshold, finding.unit))} on; source: the appendix, "
        f"{text(finding.section)}.</p>",
        f'<div style="max-width: 560px">{pictures([_plot(finding)], files)}</div>',
        f"<table><tbody>{rows}</tbody></table>",
    ]
    if finding.code:
        before, then = (amount(value, finding.unit) for value in (finding.figure, finding.after))
        after = f"{before} without these lines, {then} with them."
        parts += [f"<pre>{text(finding.code)}</pre>", f"<p>{text(after)}</p>"]
    if finding.advice:
        parts.append(f"<p>{text(finding.advice)}</p>")
    return parts


def _why_not(finding: Finding) -> str:
    if finding.missing:
        return f"not measured: {finding.missing}"
    return (
        f"{amount(finding.figure, finding.unit)}, a symptom from {amount(finding.threshold, finding.unit)} on"
    )


def _plot(finding: Finding) -> Picture:
    assert finding.series is not None
    series = finding.series
    title = f"{series.name}, {series.driver}"

    def paint(axes: Axes) -> None:
        axes.set_xlabel("control step")
        axes.set_title(series.unit or series.name)
        values = np.asarray(series.values, dtype=float)
        axes.plot(np.arange(values.size), values, color=arm_color(0), linewidth=1.0)
        if finding.unit == series.unit:
            axes.axhline(finding.threshold, color=BAD, linewidth=1.0, linestyle="--")

    peak = float(np.nanmax(series.values)) if np.isfinite(series.values).any() else float("nan")
    reading = f"Largest value {peak:.3g} {series.unit}".strip() + "."
    name = f"symptom-{finding.symptom}"
    rows = [{"step": float(step), "value": float(value)} for step, value in enumerate(series.values)]
    svg = draw(name, f"{title}. {reading}", paint, height=2.2)
    return Picture(title, reading, svg, data=Plotted(name, ("step", "value"), rows))
