"""Several experiments on one page: their verdicts, their numbers under each other, their planes in one frame."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from ..config import ExperimentConfig
from ..evaluation.summary import Summary
from ..figures.picture import Picture
from ..figures.plane import judged_rows, plane_limits, plane_picture
from ..figures.plot_files import PlotFiles
from ..files import write_text
from .experiment_page import check_reportable, report_path
from .explanation import explanations
from .markup import document, pictures, section, text
from .numbers import SHORT, short_table
from .origin import about, how_it_was_made
from .verdict import verdict

Entry = tuple[ExperimentConfig, Summary]


def write_overview(entries: Sequence[Entry], path: Path, command: str = "") -> Path:
    """Writes the page; the experiments' own pages are linked relative to it and are expected to be there.

    Args:
        entries: Experiments and their numbers, in the order of the page.
        path: Where to.
        command: The command that makes the page, to be shown on it.

    Returns:
        `path`.

    Raises:
        RunStateError: Of one of them there is nothing to report yet.
    """
    for entry in entries:
        check_reportable(*entry)
    files = PlotFiles(path)
    names = ", ".join(experiment.name for experiment, _ in entries)
    blocks = [
        (f'<a href="{_link(experiment, path)}">{text(experiment.name)}</a>', experiment, summary)
        for experiment, summary in entries
    ]
    body = "\n".join(
        (
            f"<header><h1>{len(entries)} experiments</h1><p>{text(names)}</p></header>",
            section("In a sentence each", _verdicts(entries, path)),
            section("In numbers", short_table(blocks)),
            section("Return against cost", _planes(entries, files)),
            section("What each number is", explanations(SHORT)),
            section("How it was made", how_it_was_made(command)),
        )
    )
    files.write()
    write_text(path, document(f"{names}: safe-wrappers overview", body))
    return path


def _verdicts(entries: Sequence[Entry], path: Path) -> str:
    return "".join(
        f'<article class="card"><h3><a href="{_link(experiment, path)}">{text(experiment.name)}</a></h3>'
        f"<p>{text(' '.join(verdict(experiment, summary)))}</p>"
        f'<p class="other">{text(about(experiment))}</p></article>'
        for experiment, summary in entries
    )


def _planes(entries: Sequence[Entry], files: PlotFiles) -> str:
    arms = list(dict.fromkeys(arm.name for experiment, _ in entries for arm in experiment.arms))
    drawn = []
    for at, (experiment, summary) in enumerate(entries):
        if not summary.judged:
            drawn.append(Picture(experiment.name, "Violations are not judged: the task reports no cost."))
            continue
        alike = [other for candidate, other in entries if _tasks(candidate) == _tasks(experiment)]
        evaluated = [other for other in alike if judged_rows(other)]
        limits = plane_limits(evaluated) if evaluated else None
        drawn.append(plane_picture(summary, arms, f"plane-{at}", experiment.name, limits))
    return (
        pictures(drawn, files)
        + "<p>Experiments on the same task share their axes; an arm's name has one colour.</p>"
    )


def _tasks(experiment: ExperimentConfig) -> set[str]:
    return {arm.env.id for arm in experiment.arms}


def _link(experiment: ExperimentConfig, path: Path) -> str:
    """From the page to the experiment's own, so that the folder can be moved as a whole."""
    return text(quote(os.path.relpath(report_path(experiment), path.parent).replace(os.sep, "/")))
