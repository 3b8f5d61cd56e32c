"""What a run begins with: the policy of another arm of its experiment, or of an SB3 file."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gymnasium import Space
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from safe_wrappers.errors import ConfigurationError

from ..config import ArmConfig
from .checkpoint import NORMALIZE
from .data_pickles import pickles_of_model, read_pickle


@dataclass(frozen=True)
class Start:
    """Whose policy a run begins with: of the file `path`; or, with an `arm`, of the run of that arm in that folder.

    `name` is as the config has it.
    """

    name: str
    path: Path
    arm: ArmConfig | None = None


@dataclass(frozen=True)
class Policy:
    """What has to be the same for a policy to go on in another run."""

    observation_space: Space[Any]
    action_space: Space[Any]
    weights: dict[str, Any]
    """Name -> tensor."""
    statistics: dict[str, Any]
    """What VecNormalize knows: `ret_rms`, and `obs_rms` if observations are scaled; empty without one."""
    timesteps: int = 0


def policy_of_model(model: BaseAlgorithm) -> Policy:
    """Of a model that is there."""
    statistics = _statistics(model.get_vec_normalize_env())
    return Policy(model.observation_space, model.action_space, model.policy.state_dict(), statistics)


def policy_of_file(path: Path) -> Policy:
    """Of a model that SB3 has saved; running statistics are looked for in `vecnormalize.pkl` beside it.

    Raises:
        ConfigurationError: There is none, or it is no SB3 model.
        RunStateError: A pickle in it names what is no data.
    """
    beside = path.parent / NORMALIZE
    try:
        data, parameters, _ = load_from_zip_file(path, device="cpu", custom_objects=pickles_of_model(path))
        assert data is not None
        return Policy(
            data["observation_space"],
            data["action_space"],
            parameters["policy"],
            _statistics(read_pickle(beside) if beside.exists() else None),
            int(data["num_timesteps"]),
        )
    except (OSError, ValueError, AssertionError, KeyError) as error:
        raise ConfigurationError(
            f"start_from: {str(path)!r} is no model that Stable-Baselines3 has saved ({error})."
        ) from None


def refuse_misfit(where: str, name: str, theirs: Policy, ours: Policy) -> None:
    """Refuses a policy that cannot go on in an arm.

    Args:
        where: The arm's key in the config.
        name: Whose policy it is.
        theirs: That policy.
        ours: The one that the arm would have made.

    Raises:
        ConfigurationError: Other spaces, another policy, or other scaling of observations.
    """
    there, here = (
        {
            "observation space": policy.observation_space,
            "action space": policy.action_space,
            f"scaling of observations (normalize.observation; of a file in {NORMALIZE})": "obs_rms"
            in policy.statistics,
        }
        | {f"shape of {key}": tuple(tensor.shape) for key, tensor in policy.weights.items()}
        for policy in (theirs, ours)
    )
    differ = [key for key in there | here if there.get(key) != here.get(key)]
    if differ:
        lines = (f"  {key}: {there.get(key)} there, {here.get(key)} here" for key in differ[:3])
        raise ConfigurationError(f"{where}: the policy of {name} does not fit:\n" + "\n".join(lines))


def begin_with(model: BaseAlgorithm, where: str, name: str, path: Path) -> dict[str, Any]:
    """Puts a saved policy, and the running statistics beside it, into a new model; its optimizer begins anew.

    Returns:
        What happened, for the run's folder.

    Raises:
        ConfigurationError: There is no such policy, or it does not fit.
    """
    policy = policy_of_file(path)
    refuse_misfit(where, name, policy, policy_of_model(model))
    model.policy.load_state_dict(policy.weights)
    scaling = model.get_vec_normalize_env()
    if scaling is not None:
        vars(scaling).update(deepcopy(policy.statistics))
    return {"from": name, "timesteps": policy.timesteps}


def _statistics(scaling: VecNormalize | None) -> dict[str, Any]:
    # Not by attribute: an unpickled one has no envs yet, which it would ask for what it does not have.
    known = {} if scaling is None else vars(scaling)
    return {name: known[name] for name in ("obs_rms", "ret_rms") if name in known}
