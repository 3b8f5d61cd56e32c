"""`safe-wrappers diagnose`: symptoms of an env and of a trained policy, printed, and as JSON."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
from rich.console import Console
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.save_util import load_from_zip_file

from safe_wrappers.diagnosis import Diagnosis, diagnose
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.record_interventions import RecordInterventions

from .config.algorithms import ALGORITHMS
from .files import write_text
from .policies import load_policy
from .run.data_pickles import pickles_of_model
from .run.stack import make_env

Policy = Callable[[Any], Any]
_OF_PACKAGE: Final = {"recurrent": "RecurrentPPO", "maskable": "MaskablePPO"}


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
        policy: A run's folder, or a model.zip; None: random and attacking drivers alone.
        steps: Control steps of each driver.
        output: Where the JSON goes.
        console: Where the table goes.
        imports: As `load_policy` takes it.
    """
    acts: Any = None
    if policy is not None and policy.suffix != ".zip":
        env, acts = of_run(policy, env_id, imports)
    else:
        env = make_env(env_id, {})
        acts = acts if policy is None else of_file(policy)
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


def of_file(path: Path) -> Any:
    """A model of Stable-Baselines3 or sb3-contrib; its class is found by its policy's.

    Raises:
        ConfigurationError: There is no such file, or it is no model.
        RunStateError: A pickle in it names what is no data.
    """
    try:
        pickled = pickles_of_model(path)
        data, _, _ = load_from_zip_file(path, device="cpu", custom_objects=pickled)
        assert data is not None
        name = _algorithm(data)
    except (OSError, zipfile.BadZipFile, ValueError, AssertionError, KeyError, AttributeError) as error:
        raise ConfigurationError(
            f"--policy: {str(path)!r} is no model that Stable-Baselines3 has saved ({error})"
        ) from None
    return ALGORITHMS[name].load(path, device="cpu", custom_objects=pickled)


def _algorithm(data: dict[str, Any]) -> str:
    """Whose model it is: the file names the policy's class alone."""
    package = data["policy_class"].__module__.split(".")[-2]
    if package in _OF_PACKAGE:
        return _OF_PACKAGE[package]
    if package == "common":  # PPO's, A2C's and TRPO's policies have one class
        return "PPO" if "clip_range" in data else "TRPO" if "cg_max_steps" in data else "A2C"
    found = [name for name in ALGORITHMS if name.lower() == package]
    if not found:
        raise ValueError(f"policies of {package!r} are not among {', '.join(ALGORITHMS)}")
    return found[0]
