"""From a run's folder, or from what a run leaves for others, to a policy that acts."""

from __future__ import annotations

import json
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym

from safe_wrappers.errors import ConfigurationError, RunStateError

from ..config import ArmConfig
from ..config.stored import stored_arm
from ..run.checkpoint import latest_checkpoint
from ..run.folder import CHECKPOINTS, RUN_FILE
from ..run.policy import TrainedPolicy
from ..run.portable import CONFIG, POLICY, constraints_of, filter_spec, read_policy
from .hub import HUB, download


def load_policy(
    run: Path | str,
    env: gym.Env[Any, Any] | None = None,
    *,
    other_env: bool = False,
    other_filter: bool = False,
    imports: Collection[str] = (),
) -> TrainedPolicy:
    """Load a trained policy.

    Args:
        run: A run's folder, `runs/NAME/ARM/seed_N`, whose newest checkpoint is taken, also of one that is not
            finished; or a policy's folder, `RUN/policy`, from which nothing is unpickled; or `hub:owner/name`, one
            that was uploaded.
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
        RunStateError: Files are unreadable or damaged.
    """
    folder = download(run.removeprefix(HUB)) if isinstance(run, str) and run.startswith(HUB) else Path(run)
    trained = _of_run(folder) if (folder / RUN_FILE).is_file() else _of_folder(folder, other_filter, imports)
    if env is not None:
        _refuse_misfit(trained, env, other_env, other_filter)
    return trained


def _of_run(folder: Path) -> TrainedPolicy:
    file = folder / RUN_FILE
    try:
        stored = json.loads(file.read_text())
        name, fingerprint = stored["arm"], stored["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise RunStateError(f"{str(file)!r} is unreadable: {error!r}") from error
    checkpoint = latest_checkpoint(folder / CHECKPOINTS, lambda line: warnings.warn(line, stacklevel=4))
    if checkpoint is None:
        raise ConfigurationError(f"{str(folder)!r} has no checkpoint yet")
    return TrainedPolicy(stored_arm(name, fingerprint), checkpoint)


def _of_folder(folder: Path, other_filter: bool, imports: Collection[str]) -> TrainedPolicy:
    if not (folder / CONFIG).is_file():
        raise ConfigurationError(
            f"{str(folder)!r} is no run's folder (it has no {RUN_FILE}), and no policy's (it has no {CONFIG}): give"
            f" runs/NAME/ARM/seed_N, or the folder `{POLICY}` of a run"
        )
    saved = read_policy(folder)
    for place, module in _modules(saved.arm):
        if module not in imports:
            raise ConfigurationError(
                f"the policy in {str(folder)!r} wants the module {module!r} ({place} of its {CONFIG}), and an import"
                f" runs what is in it. If you know the module: load_policy(..., imports=[{module!r}]), or --imports"
                f" {module}"
            )
    here = filter_spec(saved.arm)["constraints"]
    if here != saved.spec["constraints"] and not other_filter:
        raise ConfigurationError(
            f"the policy in {str(folder)!r} was trained through another filter than this version of the library makes"
            f" of its config:\n{_both(saved.spec['constraints'], here)}\n"
            "load_policy(..., other_filter=True) loads it anyway"
        )
    return TrainedPolicy(saved.arm, saved)


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


def _refuse_misfit(
    trained: TrainedPolicy, env: gym.Env[Any, Any], other_env: bool, other_filter: bool
) -> None:
    for what in ("observation_space", "action_space"):
        there, here, name = getattr(trained.model, what), getattr(env, what), what.replace("_", " ")
        if there != here:
            raise ConfigurationError(f"the policy is for another {name}: {there}; the env has {here}")
    task = env.spec.id if env.spec is not None else "an env without an id"
    if task != trained.arm.env.id.rpartition(":")[2] and not other_env:
        raise ConfigurationError(
            f"the policy was trained on {trained.arm.env.id}, not on {task};"
            " load_policy(..., other_env=True) loads it anyway"
        )
    expected, found = filter_spec(trained.arm)["constraints"], constraints_of(env)
    if expected != found and not other_filter:
        raise ConfigurationError(
            f"the policy was trained through another filter than the env has:\n{_both(expected, found)}\n"
            "load_policy(..., other_filter=True) loads it anyway"
        )


def _both(there: list[str], here: list[str]) -> str:
    return f"  trained: {'; '.join(there) or 'no filter'}\n  here: {'; '.join(here) or 'no filter'}"
