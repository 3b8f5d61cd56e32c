"""The `safe-wrappers` command.

What takes long to import (torch, Stable-Baselines3, Matplotlib) is imported where it is needed: not for `--help`,
and not before the config file could be read.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from safe_wrappers.errors import ConfigurationError, SafeWrappersError

from .config.file import read_config
from .local_imports import importable
from .processes.output import lasting_output
from .processes.stopping import Interrupted

if TYPE_CHECKING:
    from rich.console import Console

_COMMANDS = {
    "train": "train every arm with every seed; a killed run goes on where it was, a finished one is left",
    "evaluate": "evaluate the trained policies on the same episodes, with the filter off and on",
    "compare": "train, evaluate, and print the comparison",
    "report": "write the comparison as one HTML page, from what is already there; of several, also an overview",
}

_OPTIONS = {"compare": " [--report]", "report": " [CONFIG.yaml ...] [--output PAGE.html]"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status. Output that nobody reads any more does not stop it."""
    with lasting_output():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    parser = _parser()
    # argparse takes words only right behind the first ones; behind an option they arrive as unknown.
    options, rest = parser.parse_known_args(arguments)
    words = [*options.words, *rest]
    options.configs = [Path(word) for word in words if "=" not in word and not word.startswith("-")]
    options.overrides = [word for word in words if "=" in word and not word.startswith("-")]
    unknown = [word for word in words if word.startswith("-")]
    if options.command != "report":
        unknown += map(str, options.configs[1:])
    if unknown:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    if not options.configs:
        parser.error("the following arguments are required: CONFIG.yaml")
    from rich.console import Console

    try:
        with importable([*(config.parent for config in options.configs), Path.cwd()]):
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
    if options.command == "report":
        _report(options.configs, options.overrides, options.output, console)
        return
    (config,) = options.configs
    settings = read_config(config, options.overrides)

    from .config import parse_experiment
    from .experiment import evaluate_experiment, summarize_experiment, train_experiment
    from .report import verdict, write_report
    from .report.terminal_table import comparison_table

    experiment = parse_experiment(settings)
    if options.command in ("train", "compare"):
        train_experiment(experiment, console)
    if options.command in ("evaluate", "compare"):
        evaluate_experiment(experiment, console)
    summary = summarize_experiment(experiment)
    if options.command in ("evaluate", "compare"):
        console.print(comparison_table(experiment, summary))
        console.print("\n".join(verdict(experiment, summary)), highlight=False, markup=False)
    if getattr(options, "report", False):
        path = write_report(experiment, summary, _compare_command(config, options.overrides))
        console.print(f"Report: {path}", soft_wrap=True, highlight=False)
    console.print(f"Files: {experiment.folder}", soft_wrap=True, highlight=False)


def _report(configs: Sequence[Path], overrides: Sequence[str], output: Path | None, console: Console) -> None:
    """Of one config its page; of several a page each, and one that puts them side by side."""
    settings = [read_config(config, overrides) for config in configs]

    from .config import parse_experiment
    from .experiment import summarize_experiment
    from .report import write_overview, write_report

    experiments = [parse_experiment(each) for each in settings]
    folders = [experiment.folder for experiment in experiments]
    for folder in folders:
        if folders.count(folder) > 1:
            raise ConfigurationError(f"report: two configs name the same experiment, {str(folder)!r}.")
    entries = [(experiment, summarize_experiment(experiment)) for experiment in experiments]
    for config, (experiment, summary) in zip(configs, entries, strict=True):
        alone = output if len(entries) == 1 else None
        path = write_report(experiment, summary, _compare_command(config, overrides), alone)
        console.print(f"Report: {path}", soft_wrap=True, highlight=False)
        console.print(f"Files: {experiment.folder}", soft_wrap=True, highlight=False)
    if len(entries) > 1:
        path = output or experiments[0].output / "overview.html"
        write_overview(entries, path, shlex.join(["safe-wrappers", "report", *map(str, configs), *overrides]))
        console.print(f"Overview: {path}", soft_wrap=True, highlight=False)


def _compare_command(config: Path, overrides: Sequence[str]) -> str:
    return shlex.join(["safe-wrappers", "compare", str(config), *overrides, "--report"])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="safe-wrappers", description="Train with and without a safety filter, and compare."
    )
    parser.add_argument("--version", action="version", version=version("safe-wrappers"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in _COMMANDS.items():
        usage = f"safe-wrappers {name} CONFIG.yaml [key=value ...]{_OPTIONS.get(name, '')}"
        command = commands.add_parser(name, help=text, description=text, usage=usage)
        command.add_argument(
            "words",
            nargs="+",
            metavar="CONFIG.yaml, key=value",
            help="the experiment, and overrides such as total_steps=1000 or arms.filtered.filter=protect",
        )
        if name == "compare":
            command.add_argument("--report", action="store_true", help="also write the HTML report")
        if name == "report":
            command.add_argument(
                "--output",
                type=Path,
                metavar="PAGE.html",
                help="where to (default: report.html beside the runs; of several, overview.html)",
            )
    return parser


if __name__ == "__main__":
    sys.exit(main())
