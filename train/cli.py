"""The `safe-wrappers` command.

What takes long to import (torch, Stable-Baselines3, Matplotlib) is imported where it is needed: not for `--help`,
and not before the config file could be read.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from safe_wrappers.errors import ConfigurationError, SafeWrappersError

from .command_line import DIAGNOSED_STEPS, ENJOYED_EPISODES, FILTERS, parse
from .local_imports import importable
from .processes.output import lasting_output
from .processes.stopping import Interrupted
from .processes.storage import telling_of_storage

if TYPE_CHECKING:
    from rich.console import Console

    from .config import ExperimentConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status. Output that nobody reads any more does not stop it."""
    with lasting_output():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    options = parse(arguments)
    from rich.console import Console

    try:
        with (
            telling_of_storage(Path.cwd()),
            importable([*(config.parent for config in options.configs), Path.cwd()]),
        ):
            _run(options, Console())
    except SafeWrappersError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except Interrupted as stop:
        lines = [f"  {line}" for line in stop.standing]
        print("\n".join(["Stopped. The same command goes on" + ":" * bool(lines), *lines]), file=sys.stderr)
        return 128 + stop.signum
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return 130
    return 0


def _run(options: argparse.Namespace, console: Console) -> None:
    if options.command in _WITHOUT_EXPERIMENT:
        _WITHOUT_EXPERIMENT[options.command](options, console)
        return
    from .config import parse_experiment, read_config
    from .processes.on_ray import check_place

    check_place(options.on)
    settings = [read_config(config, options.overrides) for config in options.configs]
    if options.command == "report":
        _report(options, [parse_experiment(each) for each in settings], console)
        return
    if options.command == "sweep":
        from .sweep import sweep_experiment

        sweep_experiment(settings[0], options.configs[0], options.overrides, console, options.on)
        return

    from .experiment import evaluate_experiment, summarize_experiment, train_experiment
    from .report import verdict, write_report
    from .report.terminal_table import comparison_table

    experiment = parse_experiment(settings[0])
    if options.command in ("train", "compare"):
        train_experiment(experiment, console, options.on)
    if options.command in ("evaluate", "compare"):
        evaluate_experiment(experiment, console, options.on)
    summary = summarize_experiment(experiment)
    if options.command in ("evaluate", "compare"):
        console.print(comparison_table(experiment, summary))
        console.print("\n".join(verdict(experiment, summary)), highlight=False, markup=False)
    if options.report:
        path = write_report(experiment, summary, _compare_command(options.configs[0], options.overrides))
        console.print(f"Report: {path}", soft_wrap=True, highlight=False)
    console.print(f"Files: {experiment.folder}", soft_wrap=True, highlight=False)


def _diagnose(options: argparse.Namespace, console: Console) -> None:
    from .diagnose import diagnose_command

    output = options.output or Path("diagnosis.json")
    steps = DIAGNOSED_STEPS if options.steps is None else options.steps
    diagnose_command(options.words[0], options.policy, steps, output, console, options.imports or ())


def _enjoy(options: argparse.Namespace, console: Console) -> None:
    from .enjoy import enjoy_command

    episodes = options.episodes or ENJOYED_EPISODES
    enjoy_command(
        options.words[0],
        episodes,
        options.filter or FILTERS[0],
        options.render,
        options.output,
        console,
        options.imports or (),
    )


def _push(options: argparse.Namespace, console: Console) -> None:
    from .policies.hub import upload

    names = upload(Path(options.words[0]), options.words[1])
    console.print(f"Uploaded: {', '.join(names)}", highlight=False, soft_wrap=True)


def _list(options: argparse.Namespace, console: Console) -> None:
    from .listing import list_command

    list_command(options.words, console)


def _init(options: argparse.Namespace, console: Console) -> None:
    from .first_config import init_command

    init_command(next(iter(options.configs), None), options.overrides, console)


def _schema(options: argparse.Namespace, console: Console) -> None:
    from .config.schema import config_schema

    print(json.dumps(config_schema(), indent=1))


_WITHOUT_EXPERIMENT: Final = {
    "diagnose": _diagnose,
    "enjoy": _enjoy,
    "push": _push,
    "list": _list,
    "init": _init,
    "schema": _schema,
}


def _report(options: argparse.Namespace, experiments: list[ExperimentConfig], console: Console) -> None:
    """Of one config its page; of several a page each, and one that puts them side by side."""
    from .experiment import summarize_experiment
    from .report import write_overview, write_report

    folders = [experiment.folder for experiment in experiments]
    for folder in folders:
        if folders.count(folder) > 1:
            raise ConfigurationError(f"report: two configs name the same experiment, {str(folder)!r}.")
    entries = [(experiment, summarize_experiment(experiment)) for experiment in experiments]
    for config, (experiment, summary) in zip(options.configs, entries, strict=True):
        alone = options.output if len(entries) == 1 else None
        path = write_report(experiment, summary, _compare_command(config, options.overrides), alone)
        console.print(f"Report: {path}", soft_wrap=True, highlight=False)
        console.print(f"Files: {experiment.folder}", soft_wrap=True, highlight=False)
    if len(entries) > 1:
        path = options.output or experiments[0].output / "overview.html"
        again = ["safe-wrappers", "report", *map(str, options.configs), *options.overrides]
        write_overview(entries, path, shlex.join(again))
        console.print(f"Overview: {path}", soft_wrap=True, highlight=False)


def _compare_command(config: Path, overrides: Sequence[str]) -> str:
    return shlex.join(["safe-wrappers", "compare", str(config), *overrides, "--report"])


if __name__ == "__main__":
    sys.exit(main())
