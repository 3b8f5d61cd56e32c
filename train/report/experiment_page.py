"""One experiment's page: what the filter bought and what it cost, to be understood in a minute."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from safe_wrappers.errors import RunStateError

from ..config import ExperimentConfig
from ..evaluation.summary import Summary
from ..figures.plot_files import PlotFiles
from ..files import write_text
from . import sections
from .explanation import explanations
from .film_section import films
from .headline import cards
from .markup import details, document, section, text
from .numbers import RUN_NUMBERS, SHORT, full_table, runs_table, seeds_columns, seeds_table, short_table
from .origin import about, how_it_was_made, settings
from .verdict import verdict


def write_report(
    experiment: ExperimentConfig, summary: Summary, command: str = "", path: Path | None = None
) -> Path:
    """Writes an experiment's page, and beside it the data of its pictures, a CSV file each.

    Args:
        experiment: The experiment; what its folder holds is shown, nothing is trained.
        summary: Its numbers.
        command: The command that makes the experiment, for the page.
        path: Where to; `report.html` in the experiment's folder if not given.

    Returns:
        Where the page is.

    Raises:
        RunStateError: There is nothing to report yet.
    """
    check_reportable(experiment, summary)
    path = path or report_path(experiment)
    files = PlotFiles(path)
    page = _page(experiment, summary, command, files)
    files.write()
    write_text(path, page)
    return path


def report_path(experiment: ExperimentConfig) -> Path:
    """Where an experiment's page lies."""
    return experiment.folder / "report.html"


def check_reportable(experiment: ExperimentConfig, summary: Summary) -> None:
    """Refuses an experiment of which nothing is there.

    Raises:
        RunStateError: No run has finished an episode.
    """
    if not summary.per_seed:
        raise RunStateError(
            f"Nothing to report in {str(experiment.folder)!r} yet; run `safe-wrappers compare` first."
        )


def _page(experiment: ExperimentConfig, summary: Summary, command: str, files: PlotFiles) -> str:
    return document(
        f"{experiment.name}: safe-wrappers report", "\n".join(_parts(experiment, summary, command, files))
    )


def _parts(experiment: ExperimentConfig, summary: Summary, command: str, files: PlotFiles) -> Iterator[str]:
    yield f"<header><h1>{text(experiment.name)}</h1><p>{text(about(experiment))}</p></header>"
    first, *rest = verdict(experiment, summary)
    yield f'<p class="verdict">{text(first)}</p>'
    yield f"<ul>{''.join(f'<li>{text(part)}</li>' for part in rest)}</ul>" if rest else ""
    yield cards(experiment, summary)
    yield section(
        "In numbers", short_table([("", experiment, summary)]), sections.table_note(experiment, summary)
    )
    yield section(
        "The same episode, filter off and on",
        sections.which_episode(experiment),
        films(experiment),
        sections.from_above(experiment, files),
    )
    yield section("What it bought and what it cost", sections.outcome(experiment, summary, files))
    yield section("When, where and how much the filter stepped in", sections.interventions(experiment, files))
    yield section("While training", sections.training(experiment, summary, files))
    yield section("Run by run", runs_table(experiment, summary), sections.runs_note(experiment))
    yield section("How to read this", sections.notes(experiment, summary))
    yield section("What each number is", explanations([*SHORT, *RUN_NUMBERS, *seeds_columns(summary)]))
    yield section(
        "How it was made",
        how_it_was_made(command),
        details("Settings", settings(experiment)),
        details("Every metric", full_table(experiment, summary)),
        details("Every seed", seeds_table(summary)),
    )
