"""What the command can be told: its words and options, and which command takes which."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Final

COMMANDS: Final = {
    "train": "train every arm with every seed; a killed run goes on where it was, a finished one is left",
    "evaluate": "evaluate the trained policies on the same episodes, with the filter off and on",
    "compare": "train, evaluate, and print the comparison",
    "sweep": "search the settings under `sweep` in the config, for the most return at cost zero",
    "report": "write the comparison as one HTML page, from what is already there; of several, also an overview",
    "enjoy": "let a trained policy act, in a window or on film if asked; takes RUN for CONFIG.yaml",
    "push": "upload a run's policy to the Hugging Face hub; takes RUN and owner/name for CONFIG.yaml",
    "diagnose": "run an env, and a policy: what is wrong, and which wrapper treats it; takes ENV for CONFIG.yaml",
    "list": "print the names of envs, recipes, wrappers, algorithms and configs, or of those kinds that are named",
    "init": "write a commented config to begin with; takes env=ID and algorithm=NAME",
    "schema": "print the JSON schema of configs, from which editors complete keys",
}
DIAGNOSED_STEPS: Final = 2000
ENJOYED_EPISODES: Final = 3
FILTERS: Final = ("trained", "none", "protect", "both")
_TAKEN_BY: Final = {
    "report": ("compare",),
    "on": ("train", "evaluate", "compare", "sweep"),
    "output": ("report", "diagnose", "enjoy"),
    "policy": ("diagnose",),
    "steps": ("diagnose",),
    "episodes": ("enjoy",),
    "filter": ("enjoy",),
    "render": ("enjoy",),
    "imports": ("enjoy", "diagnose"),
}
"""Which commands take an option."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line, with `configs` and `overrides` of those commands that take them.

    Raises:
        SystemExit: Something in it does not exist, or is another command's.
    """
    parser = make_parser()
    # Subparsers would take no words behind an option: `compare a.yaml --report seeds=[0]`.
    options = parser.parse_intermixed_args(arguments)
    options.given = arguments
    command = options.command
    for option, commands in _TAKEN_BY.items():
        if getattr(options, option) not in (None, False) and command not in commands:
            *others, last = commands
            takers = f"{', '.join(others)} and {last} do" if others else f"{last} does"
            parser.error(f"{command} takes no --{option}; {takers}")
    options.configs = [Path(word) for word in options.words if "=" not in word]
    options.overrides = [word for word in options.words if "=" in word]
    if command in ("diagnose", "enjoy"):
        what = {"diagnose": "ENV", "enjoy": "RUN"}[command]
        if len(options.words) != 1:
            parser.error(f"{command} takes one {what}, got {' '.join(options.words) or 'none'}")
        if command == "enjoy" and options.episodes is not None and options.episodes < 1:
            parser.error(f"--episodes: expected at least 1, got {options.episodes}")
        if options.render and options.output:
            parser.error("enjoy takes --render or --output, a window or a film")
        options.configs = []
    elif command == "push":
        if len(options.words) != 2:
            parser.error(f"push takes a RUN and owner/name, got {' '.join(options.words) or 'none'}")
        options.configs = []
    elif command == "list":
        options.configs = []
    elif command == "schema":
        if options.words:
            parser.error(f"schema takes nothing, got {' '.join(options.words)}")
    elif command == "init":
        if len(options.configs) > 1:
            parser.error("init takes one CONFIG.yaml, which it writes")
    elif not options.configs:
        parser.error("the following arguments are required: CONFIG.yaml")
    elif command != "report" and len(options.configs) > 1:
        parser.error(f"{command} takes one CONFIG.yaml; report takes several")
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
        nargs="*",
        metavar="CONFIG.yaml, key=value",
        help="the experiment, and overrides such as total_steps=1000 or arms.filtered.filter=protect",
    )
    parser.add_argument(
        "--on",
        metavar="ray[:ADDRESS]",
        help="of train, evaluate, compare and sweep: run on a Ray cluster whose nodes share the folders",
    )
    parser.add_argument("--report", action="store_true", help="of compare: also write the HTML report")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="of report: where to (default: report.html beside the runs; of several, overview.html); of diagnose "
        "(default: diagnosis.json); of enjoy: a film of a typical episode "
        "and the worst one, FILM.webp",
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
    parser.add_argument(
        "--episodes", type=int, help=f"of enjoy: episodes, seeds 0, 1, ... (default: {ENJOYED_EPISODES})"
    )
    parser.add_argument(
        "--filter",
        choices=FILTERS,
        help="of enjoy: another filter than it was trained with (default: trained); both: without one, then with it",
    )
    parser.add_argument("--render", action="store_true", help="of enjoy: draw in a window")
    parser.add_argument(
        "--imports",
        action="append",
        metavar="MODULE",
        help="of enjoy and diagnose: a module that a policy's folder may import; may be given several times",
    )
    parser.add_argument("--version", action="version", version=version("safe-wrappers"))
    return parser
