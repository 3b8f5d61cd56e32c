"""Trained policies outside of training: loaded from a run or a policy's folder, and from and to the hub."""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.errors import ConfigurationError, RunStateError

from .config.models import ArmConfig, stored_arm
from .evaluation.metrics import METRICS, NOT_JUDGED, OF_THE_JUDGE
from .evaluation.summary import CONDITIONS, episode_file, number, seed_row
from .files import read_json, read_rows, write_text
from .run.checkpoint import MODEL, NORMALIZE, latest_checkpoint
from .run.folder import CHECKPOINTS, POLICY, RUN_FILE, stored_run
from .run.policy import CONFIG, TrainedPolicy, constraints_of, constraints_of_arm

CARD: Final = "README.md"
HUB: Final = "hub:"
"""Before `owner/name` where a folder could stand."""
_FIGURES: Final = ("return", "cost", "violations", "intervention_rate", "infeasible", "fallback")


def load_policy(
    run: Path | str,
    env: gym.Env[Any, Any] | None = None,
    *,
    other_env: bool = False,
    other_filter: bool = False,
    imports: Collection[str] = (),
) -> TrainedPolicy:
    """Load a trained policy. Nothing is unpickled but data: arrays, spaces, statistics.

    Args:
        run: A run's folder, `runs/NAME/ARM/seed_N`, whose newest checkpoint is taken, also of one that is not
            finished; or a policy's folder, `RUN/policy`; or `hub:owner/name`, one that was uploaded.
        env: Where it is going to act, if not in the env of its `make_env`: checked against what it was trained in.
        other_env: It may be another task, as long as the spaces are the same.
        other_filter: The filter may be another one, or none; that of `make_env` too, where this version of the
            library makes another one of the same config.
        imports: Names of modules, beside this library's, from which a policy's folder may have functions and envs.
            What an import runs is up to the module: read it first. A run's folder is taken for one's own, and
            imports what its config names.

    Returns:
        The policy, a function of an observation; its `make_env` has the env that it was trained in.

    Raises:
        ConfigurationError: There is no policy, or it was trained in another env, or through another filter; or
            its config names a module that `imports` does not.
        RunStateError: Files are unreadable, or a pickle in them names what is no data.
    """
    folder = _download(run.removeprefix(HUB)) if isinstance(run, str) and run.startswith(HUB) else Path(run)
    if (folder / RUN_FILE).is_file():
        checkpoint = latest_checkpoint(folder / CHECKPOINTS)
        if checkpoint is None:
            raise ConfigurationError(f"{str(folder)!r} has no checkpoint yet")
        trained = TrainedPolicy(stored_run(folder), checkpoint.folder)
    else:
        config = _config_of(folder)
        arm = stored_arm(config["arm"], config["config"])
        for place, module in _modules(arm):
            if module not in imports:
                raise ConfigurationError(
                    f"the policy in {str(folder)!r} wants the module {module!r} ({place} of its {CONFIG}), and an"
                    f" import runs what is in it. If you know the module: load_policy(..., imports=[{module!r}]), or"
                    f" --imports {module}"
                )
        if not other_filter:
            _refuse_filter(config["constraints"], constraints_of_arm(arm))
        trained = TrainedPolicy(arm, folder)
    if env is not None:
        _refuse_env(trained, env, other_env)
        if not other_filter:
            _refuse_filter(constraints_of_arm(trained.arm), constraints_of(env))
    return trained


def _config_of(folder: Path) -> dict[str, Any]:
    config = read_json(folder / CONFIG)
    if not (config and (folder / MODEL).is_file()):
        raise ConfigurationError(
            f"{str(folder)!r} is no run's folder (it has no {RUN_FILE}), and no policy's (it has no {CONFIG} and"
            f" {MODEL}): give runs/NAME/ARM/seed_N, or the folder `{POLICY}` of a run"
        )
    if not {"arm", "config", "constraints"} <= config.keys():
        raise RunStateError(f"{str(folder / CONFIG)!r} does not say what the policy is of")
    return config


def _modules(arm: ArmConfig) -> Iterator[tuple[str, str]]:
    """Where a config names a module that is not of this library, and the module."""
    env = arm.env
    names = {"env.id": env.id, "env.cost": env.cost}
    for place, used in (
        ("filter", arm.filter),
        ("env.judge", env.judge),
        ("env.observation", env.observation),
    ):
        names[f"{place}.factory"] = None if used is None else used.factory
    for place, name in names.items():
        module, colon, _ = (name or "").rpartition(":")
        if colon and module.partition(".")[0] != "safe_wrappers":
            yield place, module


def _refuse_env(trained: TrainedPolicy, env: gym.Env[Any, Any], other_env: bool) -> None:
    for what in ("observation_space", "action_space"):
        there, here = getattr(trained.model, what), getattr(env, what)
        if there != here:
            raise ConfigurationError(
                f"the policy is for another {what.replace('_', ' ')}: {there}; the env has {here}"
            )
    task = env.spec.id if env.spec is not None else "an env without an id"
    if task != trained.arm.env.id.rpartition(":")[2] and not other_env:
        raise ConfigurationError(
            f"the policy was trained on {trained.arm.env.id}, not on {task};"
            " load_policy(..., other_env=True) loads it anyway"
        )


def _refuse_filter(trained: list[str], here: list[str]) -> None:
    if trained != here:
        raise ConfigurationError(
            "the policy was trained through another filter than there is here:\n"
            f"  trained: {'; '.join(trained) or 'no filter'}\n  here: {'; '.join(here) or 'no filter'}\n"
            "load_policy(..., other_filter=True) loads it anyway"
        )


def write_card(arm: ArmConfig, seed: int, run: Path) -> None:
    """Writes the card of a run's policy, with what is measured by now; does nothing if there is no policy yet."""
    config = read_json(run / POLICY / CONFIG)
    if not config:
        return
    rows = {name: read_rows(episode_file(run, name)) for name in CONDITIONS}
    measured = {name: seed_row(episodes, _FIGURES) for name, episodes in rows.items() if episodes}
    table = [["", "Steps", *(METRICS[key] for key in _FIGURES)], ["---"] * (2 + len(_FIGURES))]
    for name, row in measured.items():
        table.append([CONDITIONS[name], f"{row['steps']:,}", *(_cell(row, key) for key in _FIGURES)])
    figures = (
        "\n".join(f"| {' | '.join(cells)} |" for cells in table) if measured else "Nothing was measured yet."
    )
    constraints = "\n".join(f"* {_code(constraint)}" for constraint in config["constraints"]) or "None."
    text = f"""\
---
library_name: stable-baselines3
tags: [{json.dumps(arm.env.id)}, reinforcement-learning, deep-reinforcement-learning, safe-wrappers]
---

# {arm.algorithm} on {_code(arm.env.id)}

Arm {_code(arm.name)}, seed {seed}, trained for {config["timesteps"]:,} steps, filter `{arm.filter.kind}`, learner
`{arm.learner.kind}`; with {_code(json.dumps(config["versions"]))}.

{figures}

Figures of one seed say nothing about another one. The constraints of the filter that it was trained with:

{constraints}

A policy that was trained through a filter is no safer without it. Nothing is unpickled but data:

```python
from safe_wrappers.train.policies import load_policy

trained = load_policy("this folder")  # refuses another env or filter, unless told
env = trained.make_env()  # the filter is on
```
"""
    write_text(run / POLICY / CARD, text)


def _cell(row: Mapping[str, Any], key: str) -> str:
    missing = NOT_JUDGED if key in OF_THE_JUDGE else "-"
    return number(float(row[key])) if key in row else missing


def _code(value: object) -> str:
    """In one line, as it is but for what would end the code."""
    line = " ".join(str(value).split()).replace("`", "'")
    return f"`{line}`"


def upload(folder: Path, repo_id: str) -> list[str]:
    """Upload a policy's folder to the Hugging Face hub, file by file; the model card comes last.

    Args:
        folder: A policy's folder, or that of a run which has one.
        repo_id: `owner/name`; made if it is not there. The hub's own login is used.

    Returns:
        The names of the files.

    Raises:
        ConfigurationError: No policy, no `owner/name`, or huggingface_sb3 is not installed.
    """
    folder = folder / POLICY if (folder / POLICY).is_dir() else folder
    arm = _config_of(folder)["arm"]
    names = [name for name in (CONFIG, MODEL, NORMALIZE, CARD) if (folder / name).is_file()]
    push = _hub(repo_id).push_to_hub
    with contextlib.chdir(folder):  # it looks for the file in the current folder, whatever it is given
        for name in names:
            push(repo_id=repo_id, filename=name, commit_message=f"{arm}: {name}")
    return names


def _download(repo_id: str) -> Path:
    """Download a policy's folder; the hub's cache keeps it."""
    load = _hub(repo_id).load_from_hub
    config = Path(load(repo_id=repo_id, filename=CONFIG))
    normalize = read_json(config).get("config", {}).get("normalize", {})
    for name in (MODEL, NORMALIZE) if any(normalize.values()) else (MODEL,):
        load(repo_id=repo_id, filename=name)
    return config.parent


def _hub(repo_id: str) -> Any:
    owner, _, name = repo_id.partition("/")
    if not (owner and name) or "/" in name:
        raise ConfigurationError(f"expected owner/name of a repository on the hub, got {repo_id!r}")
    try:
        return importlib.import_module("huggingface_sb3")
    except ImportError as error:
        raise ConfigurationError(
            f"the hub needs huggingface_sb3, which cannot be imported ({error}): pip install 'safe-wrappers[hub]'"
        ) from None
