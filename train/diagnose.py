"""`safe-wrappers diagnose`: symptoms of an env and of a trained policy, printed, and as JSON."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import gymnasium as gym
from rich.console import Console
from stable_baselines3.common.monitor import Monitor

from safe_wrappers.diagnosis import Diagnosis, diagnose
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.record_interventions import RecordInterventions

from .files import write_text
from .policies import load_policy
from .run.stack import make_env

Policy = Callable[[Any], Any]


def diagnose_command(
    env_id: str,
    policy: Path | None,
    steps: int,
    output: Path,
    console: Console,
    imports: Collection[str] = (),
) -> Diagnosis:
    """Diagnose an env by its id, print what was found, and write the same as JSON.

    Args:
        env_id: As `gym.make` takes it.
        policy: A run's folder; None: random and attacking drivers alone.
        steps: Control steps of each driver.
        output: Where the JSON goes.
        console: Where the table goes.
        imports: As `load_policy` takes it.
    """
    env, acts = (make_env(env_id, {}), None) if policy is None else of_run(policy, env_id, imports)
    found = diagnose(env, acts, steps)
    env.close()
    write_text(output, found.as_json())
    console.print(str(found), highlight=False, markup=False, soft_wrap=True)
    console.print(f"JSON: {output}", highlight=False, markup=False, soft_wrap=True)
    return found


def of_run(folder: Path, env_id: str, imports: Collection[str] = ()) -> tuple[gym.Env[Any, Any], Policy]:
    """The policy of a run's newest checkpoint, and its env without the filter.

    Raises:
        ConfigurationError: The folder holds no run, no checkpoint, or the policy of another env.
    """
    trained = load_policy(folder, imports=imports)
    if trained.arm.env.id != env_id:
        raise ConfigurationError(
            f"--policy: {str(folder)!r} was trained on {trained.arm.env.id}, not on {env_id}: diagnose that env"
        )
    env = trained.make_env("none")
    while isinstance(env, Monitor | RecordInterventions):  # they belong outside of filters that are tried
        env = env.env
    return env, trained
