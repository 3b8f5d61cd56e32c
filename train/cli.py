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
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

from safe_wrappers.errors import SafeWrappersError

if TYPE_CHECKING:
    from rich.console import Console


COMMANDS: Final = {
    "train": "train every arm with every seed; a killed run goes on where it was, a finished one is left",
    "evaluate": "evaluate the trained policies on the same episodes, with the filter off and on",
    "compare": "train, evaluate, and print the comparison",
    "sweep": "search the settings under `sweep` in the config, for the most return at cost zero",
    "report": "write the comparison as one HTML page, from what is already there",
    "enjoy": "let a trained policy act, in a window or on film if asked",
    "push": "upload a run's policy to the Hugging Face hub",
    "diagnose": "run an env, and a policy: what is wrong, and which wrapper treats it",
    "list": "print the names of envs, recipes, wrappers and algorithms, or of those kinds that are named",
    "init": "write a commented config to begin with",
    "schema": "print the JSON schema of configs, from which editors complete keys",
}
_OF_EXPERIMENTS: Final = ("train", "evaluate", "compare", "sweep", "report")
FILTERS: Final = ("trained", "none", "protect")


def make_parser(command: str) -> argparse.ArgumentParser:
    """The words and options of one command."""
    parser = argparse.ArgumentParser(prog=f"safe-wrappers {command}", description=COMMANDS[command])
    add = parser.add_argument
    if command in _OF_EXPERIMENTS:
        add("config", type=Path, metavar="CONFIG.yaml", help="the experiment")
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
            what = "another filter than it was trained with (default: trained)"
            add("--filter", choices=FILTERS, default=FILTERS[0], help=what)
            how = parser.add_mutually_exclusive_group()
            how.add_argument("--render", action="store_true", help="draw in a window")
            what = "a film of the episode with the median return"
            how.add_argument("--output", type=Path, metavar="FILM.webp", help=what)
        else:
            add("env", metavar="ENV", help="an id of gymnasium.make")
            add("--policy", type=Path, metavar="RUN", help="a run's folder")
            add("--steps", type=int, default=2000, help="control steps (default: %(default)s)")
        what = "a module that a policy's folder may import; may be given several times"
        add("--imports", action="append", metavar="MODULE", default=[], help=what)
    elif command == "push":
        add("run", type=Path, metavar="RUN", help="a run's folder, or a policy's")
        add("repository", metavar="owner/name", help="made if it is not there")
    elif command == "list":
        add("kinds", nargs="*", metavar="KIND", help="envs, recipes, wrappers, algorithms")
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
    try:
        from rich.console import Console

        from .processes import Interrupted
    except ModuleNotFoundError as missing:
        needs = f"{missing.name}: pip install 'safe-wrappers[train]'"
        print(f"error: safe-wrappers {command} needs {needs}", file=sys.stderr)
        return 1
    try:
        # Modules of one's own, last: a file called yaml.py must not take an installed module's place.
        sys.path += [str(at.resolve()) for at in (getattr(options, "config", Path()).parent, Path.cwd())]
        run = _experiment if command in _OF_EXPERIMENTS else _other
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


def _experiment(command: str, options: argparse.Namespace, overrides: list[str], console: Console) -> None:
    from .config import parse_experiment, read_config
    from .processes.on_ray import check_place

    place = getattr(options, "on", None)
    check_place(place)
    settings = read_config(options.config, overrides)
    if command == "sweep":
        from .sweep import sweep_experiment

        sweep_experiment(settings, options.config, overrides, console, place)
        return

    from .experiment import evaluate_experiment, summarize_experiment, train_experiment
    from .files import say
    from .report import comparison_table, verdict, write_report

    experiment = parse_experiment(settings)
    if command in ("train", "compare"):
        train_experiment(experiment, console, place)
    if command in ("evaluate", "compare"):
        evaluate_experiment(experiment, console, place)
    summary = summarize_experiment(experiment)
    if command in ("evaluate", "compare"):
        console.print(comparison_table(experiment, summary))
        console.print("\n".join(verdict(experiment, summary)), highlight=False, markup=False)
    if command == "report" or (command == "compare" and options.report):
        line = shlex.join(["safe-wrappers", "compare", str(options.config), *overrides, "--report"])
        path = write_report(experiment, summary, line, getattr(options, "output", None))
        say(console, f"Report: {path}")
    say(console, f"Files: {experiment.folder}")


def _other(command: str, options: argparse.Namespace, overrides: list[str], console: Console) -> None:
    """The commands that take no experiment."""
    match command:
        case "diagnose":
            from .acting import diagnose_command

            diagnose_command(options.env, options.policy, options.steps, console, options.imports)
        case "enjoy":
            from .acting import enjoy_command

            how = options.filter, options.render, options.output
            enjoy_command(options.run, options.episodes, *how, console, options.imports)
        case "push":
            from .policies import upload

            console.print(f"Uploaded: {', '.join(upload(options.run, options.repository))}")
        case "list":
            from .init import list_command

            list_command(options.kinds, console)
        case "init":
            from .init import init_command

            init_command(options.config, overrides, console)
        case "schema":
            from .config.schema import config_schema

            print(json.dumps(config_schema(), indent=1))


if __name__ == "__main__":
    sys.exit(main())
