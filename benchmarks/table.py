"""What safety costs in return, task by task: SAC without a filter, through it, with it afterwards, and Lagrangian.

SAC is Stable-Baselines3's or, with `_sbx` in a task's name, sbx's (`pip install 'safe-wrappers[sbx]'`).

    make table
    python -m benchmarks table --only SafeCarGoal1_sac --arms filtered --seeds 0
    python -m benchmarks table --collect

Trains and evaluates what is missing: days on two cores; a killed command goes on where it was. Then writes
`benchmarks/results/table.csv`, a row per run and condition, and `table.md`, which the docs show. A row stays until
its run is found anew, so that several machines fill one table. `--collect` makes it of what is there.
"""

import csv
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks import tables
from safe_wrappers.train.config import parse_experiment, read_config
from safe_wrappers.train.config.models import ExperimentConfig
from safe_wrappers.train.evaluation.summary import estimate, number, summarize
from safe_wrappers.train.experiment import evaluate_experiment, train_experiment
from safe_wrappers.train.files import read_json, read_rows, write_rows
from safe_wrappers.train.run.folder import POLICY
from safe_wrappers.train.run.policy import CONFIG

ROOT = Path(__file__).parents[1]
RESULTS = tables.RESULTS / "table.csv"
VERSIONS = ("gymnasium", "mujoco", "stable-baselines3", "torch", "sbx-rl")


@dataclass(frozen=True)
class Task:
    """An env of the table, its config, how many seeds, overrides of the config, and the end of its folder's name."""

    env_id: str
    config: str
    seeds: int
    overrides: tuple[str, ...] = ()
    more: str = ""

    @property
    def name(self) -> str:
        """Of the experiment."""
        return f"{self.env_id.removesuffix('-v0')}_sac{self.more}"


SLOWER = ("action_repeat=8", "hyperparameters.gamma=0.97")
"""An action for eight control steps: half the decisions, and half the updates."""
SBX = "algorithm=sbx.SAC"
HALF = "hyperparameters.gradient_steps=2"
"""Half an update for an action: twice the actions in the same time."""
NORM = "hyperparameters.policy_kwargs.layer_norm=true"
TASKS = (
    Task("SafePointGoal1-v0", "goal_sac", 5),
    Task("SafePointGoal1-v0", "goal_sac", 5, ("total_steps=250000",), "_1m"),
    Task("SafePointGoal1-v0", "goal_sac", 5, ("total_steps=50000", *SLOWER), "_8"),
    Task("SafePointGoal2-v0", "goal_sac", 3),
    Task("SafePointGoal2-v0", "goal_sac", 3, ("total_steps=250000",), "_1m"),
    Task("SafePointGoal2-v0", "goal_sac", 3, ("total_steps=50000", *SLOWER), "_8"),
    Task("SafePointGoal2-v0", "goal_sac", 3, ("total_steps=125000", *SLOWER), "_8_1m"),
    Task("SafeCarGoal1-v0", "goal_sac", 3),
    Task("SafeCarGoal2-v0", "goal_sac", 3),
    Task("SafeHalfCheetahVelocity-v0", "velocity_sac", 5),
    Task("SafeHalfCheetahVelocity-v0", "velocity_sac", 5, ("total_steps=400000",), "_400k"),
    Task("SafeHopperVelocity-v0", "velocity_sac", 3),
    Task("SafeHopperVelocity-v0", "velocity_sac", 3, ("total_steps=400000",), "_400k"),
    Task("SafeWalker2dVelocity-v0", "velocity_sac", 3),
    Task("SafeSwimmerVelocity-v0", "velocity_sac", 3, ("hyperparameters.gamma=0.9999",)),
    Task("SafeAntVelocity-v0", "velocity_sac", 3),
    Task("SafePointGoal1-v0", "goal_sac", 5, ("total_steps=250000", SBX), "_sbx_1m"),
    Task("SafePointGoal1-v0", "goal_sac", 5, ("total_steps=500000", SBX, HALF), "_sbx_2m"),
    Task("SafePointGoal2-v0", "goal_sac", 3, ("total_steps=50000", SBX, *SLOWER), "_sbx_8"),
    Task("SafePointGoal2-v0", "goal_sac", 3, ("total_steps=125000", SBX, *SLOWER), "_sbx_8_1m"),
    Task("SafePointGoal2-v0", "goal_sac", 3, ("total_steps=250000", SBX, HALF, *SLOWER), "_sbx_8_2m"),
    Task("SafeCarGoal1-v0", "goal_sac", 3, (SBX,), "_sbx"),
    Task("SafeCarGoal1-v0", "goal_sac", 3, ("total_steps=250000", SBX), "_sbx_1m"),
    Task("SafeCarGoal2-v0", "goal_sac", 3, ("total_steps=50000", SBX, *SLOWER), "_sbx_8"),
    Task("SafeCarGoal2-v0", "goal_sac", 3, ("total_steps=125000", SBX, *SLOWER), "_sbx_8_1m"),
    Task("SafeHalfCheetahVelocity-v0", "velocity_sac", 5, ("total_steps=1000000", SBX), "_sbx_1m"),
    Task("SafeHopperVelocity-v0", "velocity_sac", 3, ("total_steps=1000000", SBX), "_sbx_1m"),
    Task("SafeWalker2dVelocity-v0", "velocity_sac", 3, ("total_steps=1000000", SBX, HALF), "_sbx_1m"),
    Task("SafeAntVelocity-v0", "velocity_sac", 3, ("total_steps=1000000", SBX, HALF), "_sbx_1m"),
    Task("SafeAntVelocity-v0", "velocity_sac", 3, ("total_steps=1000000", SBX, HALF, NORM), "_sbx_ln_1m"),
    Task("SafeHumanoidVelocity-v0", "velocity_sac", 3, ("total_steps=700000", SBX, HALF), "_sbx_700k"),
)
METRICS = ("return", "return_decile", "cost", "violations", "stuck", "infeasible", "intervention_rate")
COLUMNS = (
    *("task", "algorithm", "control_steps", "action_repeat", "arm", "seed", "condition", "episodes", "steps"),
    *(*METRICS, "versions", "commit"),
)
KEY = ("task", "algorithm", "control_steps", "action_repeat", "arm", "seed", "condition")
ARMS = ("unfiltered", "filtered", "lagrangian")
CONDITIONS = ("training", "filter_off", "filter_on")


def experiment_of(task: Task, output: str) -> ExperimentConfig:
    """The task's experiment, all arms and seeds."""
    seeds = f"seeds={list(range(task.seeds))}"
    overrides = [f"env.id={task.env_id}", f"name={task.name}", f"output={output}", seeds, *task.overrides]
    return parse_experiment(read_config(ROOT / "configs" / f"{task.config}.yaml", overrides))


def rows_of(task: Task, experiment: ExperimentConfig) -> list[dict[str, Any]]:
    """What is there: a row per finished and evaluated run and condition."""
    found = []
    for row in summarize(experiment).per_seed:
        arm = next(arm for arm in experiment.arms if arm.name == row["arm"])
        folder = experiment.run_folder(arm, row["seed"])
        if not (folder / "evaluation" / "evaluation.json").exists():
            continue
        steps = arm.total_steps * arm.action_repeat
        learner = f"{arm.algorithm}{', layer norm' * (NORM in task.overrides)}"
        about = {"task": task.env_id, "algorithm": learner, "control_steps": steps}
        versions = read_json(folder / POLICY / CONFIG)["versions"]
        about |= {"action_repeat": arm.action_repeat, "commit": commit()}
        about |= {"versions": ", ".join(f"{name} {versions[name]}" for name in VERSIONS if name in versions)}
        if (episodes := folder / "evaluation" / f"{row['condition']}.csv").exists():
            returns = [float(each["return"]) for each in read_rows(episodes)]
            about |= {"return_decile": float(np.quantile(returns, 0.1))}
        found.append(about | {key: row.get(key, "") for key in COLUMNS if key not in about})
    return found


def commit() -> str:
    """Of the checkout that the runs are collected in, which is to be the one that they were made with."""
    told = subprocess.run(["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return told.stdout.strip()


def merged(kept: list[dict[str, Any]], found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What is found takes the place of what was kept; in the order of the tasks, arms and conditions."""
    rows = {tuple(str(row[key]) for key in KEY): row for row in [*kept, *found]}
    tasks = list(dict.fromkeys(task.env_id for task in TASKS))

    def place(key: tuple[str, ...]) -> tuple[Any, ...]:
        task, algorithm, steps, repeat, arm, seed, condition = key
        of_arm = ARMS.index(arm), CONDITIONS.index(condition), int(seed)
        return tasks.index(task), int(repeat), algorithm, int(steps), *of_arm

    return [rows[key] for key in sorted(rows, key=place)]


def read_table() -> list[dict[str, Any]]:
    with RESULTS.open() as file:
        return list(csv.DictReader(file))


def cell(rows: Iterable[dict[str, Any]], metric: str) -> str:
    """A metric over seeds; a dash where nothing was judged or counted."""
    values = [float(row[metric]) for row in rows if row[metric] != ""]
    if not values:
        return "-"
    return str(estimate(values)).removesuffix(" [n/a]")


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table that the docs show."""
    lines = []
    for told in dict.fromkeys(tuple(row[key] for key in KEY[:4]) for row in rows):
        task, algorithm, steps, repeat = told
        of_task = [row for row in rows if tuple(row[key] for key in KEY[:4]) == told]
        for arm in dict.fromkeys(row["arm"] for row in of_task):
            same = [row for row in of_task if row["arm"] == arm]
            training, off, on = (
                [row for row in same if row["condition"] == condition] for condition in CONDITIONS
            )
            made = sum(int(row["steps"]) for row in on)
            shares = [
                f"{100 * sum(float(row[key]) for row in on) / made:.2g} %"
                if made and all(row[key] != "" for row in on)
                else "-"
                for key in ("stuck", "infeasible")
            ]
            cells = [
                task.removesuffix("-v0"),
                algorithm,
                f"{int(steps):,} x {len({row['seed'] for row in same})}",
                str(repeat),
                arm,
                number(sum(float(row["violations"]) for row in training)),
                f"{cell(off, 'return')}; {cell(off, 'cost')}",
                f"{cell(on, 'return')}; {cell(on, 'cost')}",
                cell(on, "return_decile"),
                *shares,
            ]
            lines.append(cells)
    head = "task | learner | control steps x seeds | steps per action | trained | training: violations, all seeds"
    head += " | filter off: return; cost | filter on: return; cost | lowest tenth of the episodes"
    versions = "; or ".join(dict.fromkeys(row["versions"] for row in rows))
    return f"{tables.markdown(f'{head} | stuck | infeasible', lines)}\n\nMade with {versions}.\n"


def main() -> None:
    names = [task.name for task in TASKS]
    arguments = tables.options(
        __doc__, only=names, arms=[], seeds=[], workers=int, output="runs", collect=False
    )
    rows = []
    for task in TASKS:
        whole = experiment_of(task, arguments.output)
        if task.name in arguments.only and not arguments.collect:
            part = replace(
                whole,
                arms=tuple(arm for arm in whole.arms if arm.name in (arguments.arms or (arm.name,))),
                seeds=[seed for seed in whole.seeds if str(seed) in (arguments.seeds or (str(seed),))],
                workers=arguments.workers,
            )
            train_experiment(part, Console())
            evaluate_experiment(part, Console())
        rows += rows_of(task, whole)
    write_rows(RESULTS, COLUMNS, merged(read_table(), rows))
    RESULTS.with_suffix(".md").write_text(table := markdown(read_table()))
    print(table)
