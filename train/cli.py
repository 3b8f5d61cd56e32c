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

from .local_imports import importable
from .processes.output import lasting_output
from .processes.stopping import Interrupted

if TYPE_CHECKING:
    from rich.console import Console

    from .config import ExperimentConfig

COMMANDS = {
    "train": "train every arm with every seed; a killed run goes on where it was, a finished one is left",
    "evaluate": "evaluate the trained policies on the same episodes, with the filter off and on",
    "compare": "train, evaluate, and print the comparison",
    "report": "write the comparison as one HTML page, from what is already there; of several, also an overview",
    "diagnose": "run an env, and a policy: what is wrong, and which wrapper treats it; takes ENV for CONFIG.yaml",
}

DIAGNOSED_STEPS = 2000


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status. Output that nobody reads any more does not stop it."""
    with lasting_output():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    options = _options(arguments)
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
    if options.command == "diagnose":
        from .diagnosis import diagnose_command

        output = options.output or Path("diagnosis.html")
        steps = DIAGNOSED_STEPS if options.steps is None else options.steps
        words = ["safe-wrappers", *(sys.argv[1:] if options.given is None else options.given)]
        diagnose_command(options.words[0], options.policy, steps, output, shlex.join(words), console)
        return
    from .config import parse_experiment, read_config

    settings = [read_config(config, options.overrides) for config in options.configs]
    if options.command == "report":
        _report(options, [parse_experiment(each) for each in settings], console)
        return

    from .experiment import evaluate_experiment, summarize_experiment, train_experiment
    from .report import verdict, write_report
    from .report.terminal_table import comparison_table

    experiment = parse_experiment(settings[0])
    if options.command in ("train", "compare"):
        train_experiment(experiment, console)
    if options.command in ("evaluate", "compare"):
        evaluate_experiment(experiment, console)
    summary = summarize_experiment(experiment)
    if options.command in ("evaluate", "compare"):
        console.print(comparison_table(experiment, summary))
        console.print("\n".join(verdict(experiment, summary)), highlight=False, markup=False)
    if options.report:
        path = write_report(experiment, summary, _compare_command(options.configs[0], options.overrides))
        console.print(f"Report: {path}", soft_wrap=True, highlight=False)
    console.print(f"Files: {experiment.folder}", soft_wrap=True, highlight=False)


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


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = make_parser()
    # Subparsers would take no words behind an option: `compare a.yaml --report seeds=[0]`.
    options = parser.parse_intermixed_args(arguments)
    options.given = arguments
    if options.command != "diagnose" and (options.policy or options.steps is not None):
        parser.error(f"{options.command} takes no --policy and no --steps; diagnose does")
    if options.command == "diagnose":
        if len(options.words) > 1 or options.report:
            parser.error("diagnose takes one ENV, --policy, --steps and --output")
        options.configs = []
        return options
    options.configs = [Path(word) for word in options.words if "=" not in word]
    options.overrides = [word for word in options.words if "=" in word]
    if not options.configs:
        parser.error("the following arguments are required: CONFIG.yaml")
    if options.command != "report" and (options.output or len(options.configs) > 1):
        parser.error(f"{options.command} takes one CONFIG.yaml and no --output; report does")
    if options.command != "compare" and options.report:
        parser.error(f"{options.command} takes no --report; compare does")
    return options


def make_parser() -> argparse.ArgumentParser:
    """The command's words and options."""
    parser = argparse.ArgumentParser(
        prog="safe-wrappers",
        description="Train with and without a safety filter, and compare.",
        usage="%(prog)s COMMAND CONFIG.yaml [key=value ...] [option ...]",
        epilog="commands:\n" + "\n".join(f"  {name:10}{text}" for name, text in COMMANDS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of those below")
    parser.add_argument(
        "words",
        nargs="+",
        metavar="CONFIG.yaml, key=value",
        help="the experiment, and overrides such as total_steps=1000 or arms.filtered.filter=protect",
    )
    parser.add_argument("--report", action="store_true", help="of compare: also write the HTML report")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="PAGE.html",
        help="of report: where to (default: report.html beside the runs; of several, overview.html); of diagnose "
        "(default: diagnosis.html; the same as JSON beside it)",
    )
    parser.add_argument(
        "--policy",
        type=Path,
        metavar="RUN",
        help="of diagnose: a run's folder, runs/NAME/ARM/seed_N, or a model.zip of Stable-Baselines3",
    )
    parser.add_argument(
        "--steps",
        type=int,
        help=f"of diagnose: control steps of each driver (default: {DIAGNOSED_STEPS:,})",
    )
    parser.add_argument("--version", action="version", version=version("safe-wrappers"))
    return parser


if __name__ == "__main__":
    sys.exit(main())
