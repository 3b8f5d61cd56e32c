"""The `safe-wrappers` command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

from safe_wrappers.errors import SafeWrappersError

from .config import parse_experiment
from .config_file import read_config
from .experiment import evaluate_experiment, summarize_experiment, train_experiment
from .report import write_report
from .table import comparison_table

_COMMANDS = {
    "train": "train every arm with every seed; a killed run goes on where it was, a finished one is left",
    "evaluate": "evaluate the trained policies on the same episodes, with the filter off and on",
    "compare": "train, evaluate, and print the comparison",
    "report": "write the comparison as one HTML page, from what is already there",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    parser = _parser()
    # argparse takes overrides only right behind the config; behind an option they arrive as unknown.
    options, rest = parser.parse_known_args(arguments)
    unknown = [word for word in rest if word.startswith("-") or "=" not in word]
    if unknown:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    options.overrides += rest
    console = Console()
    try:
        _run(options, console)
    except SafeWrappersError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Stopped. The same command goes on from the last checkpoints.", file=sys.stderr)
        return 130
    return 0


def _run(options: argparse.Namespace, console: Console) -> None:
    experiment = parse_experiment(read_config(options.config, options.overrides))
    if options.command in ("train", "compare"):
        train_experiment(experiment, console)
    if options.command in ("evaluate", "compare"):
        evaluate_experiment(experiment, console)
    summary = summarize_experiment(experiment)
    if options.command in ("evaluate", "compare"):
        console.print(comparison_table(experiment, summary))
    if options.command == "report" or getattr(options, "report", False):
        console.print(f"Report: {write_report(experiment, summary)}", soft_wrap=True, highlight=False)
    console.print(f"Files: {experiment.folder}", soft_wrap=True, highlight=False)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="safe-wrappers", description="Train with and without a safety filter, and compare."
    )
    parser.add_argument("--version", action="version", version=version("safe-wrappers"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in _COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("config", type=Path, metavar="CONFIG.yaml")
        command.add_argument(
            "overrides",
            nargs="*",
            metavar="key=value",
            help="override a setting, such as total_steps=1000 or arms.filtered.filter=protect",
        )
        if name == "compare":
            command.add_argument("--report", action="store_true", help="also write the HTML report")
    return parser


if __name__ == "__main__":
    sys.exit(main())
