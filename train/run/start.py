"""What a run begins with: the policy of another arm of its experiment, or of an SB3 file."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from safe_wrappers.errors import ConfigurationError

from ..config import ArmConfig
from .checkpoint import NORMALIZE
from .data_pickles import pickles_of_model, read_pickle

START_FILE: Final = "start.json"
"""In a run's folder: whose policy it began with."""
_SHOWN: Final = 3


@dataclass(frozen=True)
class Start:
    """Whose policy a run begins with.

    Attributes:
        name: As the config has it.
        path: The file; or the folder of the arm's run with the same seed.
        arm: The arm; None: a file.
    """

    name: str
    path: Path
    arm: ArmConfig | None = None


class Policy(NamedTuple):
    """What has to be the same for a policy to go on in another run."""

    kind: str
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    weights: Mapping[str, Any]
    """Name -> tensor."""
    statistics: Mapping[str, Any]
    """What VecNormalize knows: `ret_rms`, and `obs_rms` if observations are scaled; empty without one."""
    timesteps: int = 0


def policy_of_model(model: BaseAlgorithm) -> Policy:
    """Of a model that is there."""
    return Policy(
        type(model.policy).__name__,
        model.observation_space,
        model.action_space,
        model.policy.state_dict(),
        _statistics(model.get_vec_normalize_env()),
    )


def policy_of_file(path: Path) -> Policy:
    """Of a model that SB3 has saved; running statistics are looked for in `vecnormalize.pkl` beside it.

    Raises:
        ConfigurationError: There is none, or it is no SB3 model.
        RunStateError: A pickle in it names what is no data.
    """
    if not path.is_file():
        raise ConfigurationError(f"start_from: there is no file {str(path)!r}.")
    beside = path.parent / NORMALIZE
    try:
        data, parameters, _ = load_from_zip_file(path, device="cpu", custom_objects=pickles_of_model(path))
        assert data is not None
        weights: Any = parameters["policy"]
        return Policy(
            data["policy_class"].__name__,
            data["observation_space"],
            data["action_space"],
            weights,
            _statistics(read_pickle(beside) if beside.exists() else None),
            int(data["num_timesteps"]),
        )
    except (zipfile.BadZipFile, ValueError, AssertionError, KeyError, AttributeError) as error:
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
    for what in ("observation_space", "action_space"):
        there, here = getattr(theirs, what), getattr(ours, what)
        if there != here:
            raise ConfigurationError(
                f"{where}: the policy of {name} is for another {what.replace('_', ' ')}: {there}; the arm's env has"
                f" {here}."
            )
    there, here = (
        {key: tuple(tensor.shape) for key, tensor in policy.weights.items()} for policy in (theirs, ours)
    )
    differ = sorted(key for key in there.keys() | here.keys() if there.get(key) != here.get(key))
    if differ:
        shown = "; ".join(
            f"{key} {there.get(key, 'missing')} there, {here.get(key, 'missing')} here"
            for key in differ[:_SHOWN]
        )
        raise ConfigurationError(
            f"{where}: the policy of {name}, a {theirs.kind}, has other weights than the arm's {ours.kind}: {shown}"
            + (f"; and {len(differ) - _SHOWN} more" if len(differ) > _SHOWN else "")
            + ". Give both the same algorithm, policy and policy_kwargs."
        )
    has, wants = ("scaled" if "obs_rms" in p.statistics else "as they are" for p in (theirs, ours))
    if has != wants:
        raise ConfigurationError(
            f"{where}: the policy of {name} has learned from observations {has}, and the arm has them {wants}"
            f" (normalize.observation). The statistics of a file are looked for in {NORMALIZE} beside it."
        )


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
