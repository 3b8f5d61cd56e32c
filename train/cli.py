"""The `safe-wrappers` command.

What takes long to import (torch, Stable-Baselines3, Matplotlib) is imported where it is needed: not for `--help`,
and not before the config file could be read.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

from safe_wrappers.errors import ConfigurationError, SafeWrappersError

if TYPE_CHECKING:
    from rich.console import Console


COMMANDS: Final = {
    "train": "train every arm with every seed; a killed run goes on where it was, a finished one is left",
    "evaluate": "evaluate the trained policies on the same episodes, with the filter off and on",
    "compare": "train, evaluate, and print the comparison",
    "sweep": "search the settings under `sweep` in the config, for the most return at cost zero",
    "report": "write the comparison as one HTML page, from what is already there; of several, one each",
    "enjoy": "let a trained policy act, in a window or on film if asked",
    "push": "upload a run's policy to the Hugging Face hub",
    "diagnose": "run an env, and a policy: what is wrong, and which wrapper treats it",
    "list": "print the names of envs, recipes, wrappers, algorithms and configs, or of those kinds that are named",
    "init": "write a commented config to begin with",
    "schema": "print the JSON schema of configs, from which editors complete keys",
}
_OF_EXPERIMENTS: Final = ("train", "evaluate", "compare", "sweep", "report")
FILTERS: Final = ("trained", "none", "protect", "both")


def make_parser(command: str) -> argparse.ArgumentParser:
    """The words and options of one command."""
    parser = argparse.ArgumentParser(prog=f"safe-wrappers {command}", description=COMMANDS[command])
    add = parser.add_argument
    if command in _OF_EXPERIMENTS:
        many = "+" if command == "report" else 1
        add("configs", nargs=many, type=Path, metavar="CONFIG.yaml", help="the experiment")
        # They may stand before the config and behind options: `main` tells them by their "=".
        parser.epilog = "key=value overrides a setting: total_steps=1000, arms.filtered.filter=protect"
        if command == "report":
            what = "where to (default: report.html beside the runs)"
            add("--output", type=Path, metavar="FILE", help=what)
        else:
            add("--on", metavar="ray[:ADDRESS]", help="run on a Ray cluster whose nodes share the folders")
        if command == "compare":
            add("--report", action="store_true", help="also write the HTML report")
    elif command in ("enjoy", "diagnose"):
        if command == "enjoy":
            add("run", metavar="RUN", help="runs/NAME/ARM/seed_N, a policy's folder, or hub:owner/name")
            add("--episodes", type=int, default=3, help="episodes, seeds 0, 1, ... (default: %(default)s)")
            what = (
                "another filter than it was trained with (default: trained); both: without one, then with it"
            )
            add("--filter", choices=FILTERS, default=FILTERS[0], help=what)
            how = parser.add_mutually_exclusive_group()
            how.add_argument("--render", action="store_true", help="draw in a window")
            what = "a film of a typical episode and the worst one"
            how.add_argument("--output", type=Path, metavar="FILM.webp", help=what)
        else:
            add("env", metavar="ENV", help="an id of gymnasium.make")
            add("--policy", type=Path, metavar="RUN", help="a run's folder")
            add("--steps", type=int, default=2000, help="control steps of each driver (default: %(default)s)")
            what = "the same as JSON (default: %(default)s)"
            add("--output", type=Path, metavar="FILE", default=Path("diagnosis.json"), help=what)
        what = "a module that a policy's folder may import; may be given several times"
        add("--imports", action="append", metavar="MODULE", default=[], help=what)
    elif command == "push":
        add("run", type=Path, metavar="RUN", help="a run's folder, or a policy's")
        add("repository", metavar="owner/name", help="made if it is not there")
    elif command == "list":
        add("kinds", nargs="*", metavar="KIND", help="envs, recipes, wrappers, algorithms, configs")
    elif command == "init":
        default = Path("experiment.yaml")
        add("config", nargs="?", type=Path, default=default, metavar="CONFIG.yaml", help="the file to write")
        parser.epilog = "env=ID and algorithm=NAME fill it in"
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    whole = argparse.ArgumentParser(
        prog="safe-wrappers",
        description="Train with and without a safety filter, and compare.",
        epilog="commands:\n" + "\n".join(f"  {name:10}{text}" for name, text in COMMANDS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of those below")
    whole.add_argument("--version", action="version", version=version("safe-wrappers"))
    command = whole.parse_args(given[:1]).command
    overrides = [word for word in given[1:] if "=" in word and not word.startswith("-")]
    takes = command in (*_OF_EXPERIMENTS, "init")
    words = [word for word in given[1:] if not takes or word not in overrides]
    options = make_parser(command).parse_intermixed_args(words)
    from rich.console import Console

    from .processes import Interrupted

    try:
        with importable([*(config.parent for config in getattr(options, "configs", [])), Path.cwd()]):
            run = _report if command == "report" else _experiment if command in _OF_EXPERIMENTS else _other
            run(command, options, overrides, Console())
    except (SafeWrappersError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except Interrupted as stop:
        print("Stopped. The same command goes on.", file=sys.stderr)
        return 128 + stop.signum
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return 130
    return 0


@contextlib.contextmanager
def importable(folders: Sequence[Path]) -> Iterator[None]:
    """Lets Python find modules in these folders too, last of all; so do the processes that are started meanwhile."""
    added = [path for path in dict.fromkeys(str(f.resolve()) for f in folders) if path not in sys.path]
    # Last: a file of one's own called yaml.py must not take an installed module's place.
    sys.path.extend(added)
    try:
        yield
    finally:
        sys.path[:] = [path for path in sys.path if path not in added]


def _experiment(command: str, options: argparse.Namespace, overrides: list[str], console: Console) -> None:
    from .config import parse_experiment, read_config
    from .processes.on_ray import check_place

    check_place(options.on)
    settings = read_config(options.configs[0], overrides)
    if command == "sweep":
        from .sweep import sweep_experiment

        sweep_experiment(settings, options.configs[0], overrides, console, options.on)
        return

    from .experiment import evaluate_experiment, summarize_experiment, train_experiment
    from .report import comparison_table, verdict, write_report

    experiment = parse_experiment(settings)
    if command in ("train", "compare"):
        train_experiment(experiment, console, options.on)
    if command in ("evaluate", "compare"):
        evaluate_experiment(experiment, console, options.on)
    summary = summarize_experiment(experiment)
    if command in ("evaluate", "compare"):
        console.print(comparison_table(experiment, summary))
        console.print("\n".join(verdict(experiment, summary)), highlight=False, markup=False)
    if command == "compare" and options.report:
        path = write_report(experiment, summary, _compare_command(options.configs[0], overrides))
        _say(console, f"Report: {path}")
    _say(console, f"Files: {experiment.folder}")


def _report(_: str, options: argparse.Namespace, overrides: list[str], console: Console) -> None:
    """A page of each config."""
    from .config import parse_experiment, read_config
    from .experiment import summarize_experiment
    from .report import write_report

    if options.output and len(options.configs) > 1:
        raise ConfigurationError("--output is for one config; of several each page lies beside its runs")
    for config in options.configs:
        experiment = parse_experiment(read_config(config, overrides))
        command = _compare_command(config, overrides)
        path = write_report(experiment, summarize_experiment(experiment), command, options.output)
        _say(console, f"Report: {path}")


def _other(command: str, options: argparse.Namespace, overrides: list[str], console: Console) -> None:
    """The commands that take no experiment."""
    match command:
        case "diagnose":
            from .diagnose import diagnose_command

            diagnose_command(
                options.env, options.policy, options.steps, options.output, console, options.imports
            )
        case "enjoy":
            from .enjoy import enjoy_command

            how = options.filter, options.render, options.output
            enjoy_command(options.run, options.episodes, *how, console, options.imports)
        case "push":
            from .policies import upload

            _say(console, f"Uploaded: {', '.join(upload(options.run, options.repository))}")
        case "list":
            from .init import list_command

            list_command(options.kinds, console)
        case "init":
            from .init import init_command

            init_command(options.config, overrides, console)
        case "schema":
            from .config.schema import config_schema

            print(json.dumps(config_schema(), indent=1))


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, highlight=False, markup=False)


def _compare_command(config: Path, overrides: Sequence[str]) -> str:
    return shlex.join(["safe-wrappers", "compare", str(config), *overrides, "--report"])


if __name__ == "__main__":
    sys.exit(main())
