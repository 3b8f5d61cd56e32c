"""How a page was made: the command, the versions, every setting."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Final

import yaml

from ..config import ArmConfig, ExperimentConfig
from ..files import read_json
from ..run.folder import START_FILE, finished_facts
from .markup import details, table, text

_PACKAGES: Final = (
    "safe-wrappers",
    "gymnasium",
    "mujoco",
    "stable-baselines3",
    "torch",
    "numpy",
    "qpsolvers",
    "daqp",
)


def how_it_was_made(command: str) -> str:
    """The command, if it is known, and the versions that wrote the page."""
    rows = [("python", platform.python_version())]
    for package in _PACKAGES:
        try:
            rows.append((package, version(package)))
        except PackageNotFoundError:
            continue
    made = f"<pre>{text(command)}</pre>" if command else ""
    versions = table(["package", "version"], rows)
    return made + details("Versions that wrote this page", versions)


def settings(experiment: ExperimentConfig) -> str:
    """Every setting, as YAML."""
    values = asdict(experiment)
    values |= {
        "output": str(experiment.output),
        "arms": list(values["arms"]),
        "seeds": list(experiment.seeds),
    }
    return f"<pre>{text(yaml.safe_dump(values, sort_keys=False))}</pre>"


def about(experiment: ExperimentConfig) -> str:
    """What was trained on what, for how long, and how it was judged; one sentence."""
    kinds = ", ".join(dict.fromkeys(f"{arm.algorithm} on {arm.env.id}" for arm in experiment.arms))
    steps = sorted({_trained(experiment, arm, seed) for arm in experiment.arms for seed in experiment.seeds})
    how_long = f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}"
    seeds = len(experiment.seeds)
    begun = "".join(f" {sentence}" for sentence in _begun(experiment))
    return (
        f"{kinds}, {how_long} steps, {seeds} seed{'s' * (seeds > 1)}; evaluation on"
        f" {experiment.evaluation.episodes} episodes, the same ones for every arm and seed.{begun}"
    )


def _trained(experiment: ExperimentConfig, arm: ArmConfig, seed: int) -> int:
    """Control steps of a run: whole rollouts, which may be more than `total_steps`."""
    facts = finished_facts(experiment.run_folder(arm, seed))
    return int(facts.get("timesteps", arm.total_steps)) * arm.action_repeat


def _begun(experiment: ExperimentConfig) -> Iterator[str]:
    """What arms began with that did not begin at random, as their runs recorded it."""
    for arm in experiment.arms:
        path = experiment.run_folder(arm, experiment.seeds[0]) / START_FILE
        start = read_json(path)
        if start:
            yield (
                f"Arm {arm.name} began with the policy of {start['from']} after {start['timesteps']:,} steps, which"
                " do not count as its own."
            )
