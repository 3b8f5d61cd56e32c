"""What a run begins with: the policy of another arm of its experiment, or of an SB3 file."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

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


def begin_with(model: BaseAlgorithm, where: str, name: str, path: Path) -> dict[str, Any]:
    """Puts a saved policy, and the running statistics beside it, into a new model; its optimizer begins anew.

    Args:
        model: The arm's, before its first step.
        where: The arm's key in the config.
        name: Whose policy it is.
        path: A model that SB3 has saved; running statistics are looked for in `vecnormalize.pkl` beside it.

    Returns:
        What happened, for the run's folder.

    Raises:
        ConfigurationError: There is no such model; or it does not fit: other spaces, weights or scaling.
        RunStateError: A pickle in it names what is no data.
    """
    refusal = f"{where}: the policy of {name}"
    try:
        data, parameters, _ = load_from_zip_file(path, device="cpu", custom_objects=pickles_of_model(path))
        assert data is not None
    except (OSError, ValueError, AssertionError, KeyError) as error:
        raise ConfigurationError(f"{refusal}: {str(path)!r} is no model of SB3 ({error})") from None
    for what in ("observation_space", "action_space"):
        if data[what] != getattr(model, what):
            raise ConfigurationError(
                f"{refusal} is for another {what}: {data[what]}; the arm has {getattr(model, what)}"
            )
    scaling, beside = model.get_vec_normalize_env(), path.parent / NORMALIZE
    # Not by attribute: an unpickled one has no envs yet, which it would ask for what it does not have.
    known = vars(read_pickle(beside)) if beside.exists() else {}
    if ("obs_rms" in known) != ("obs_rms" in ({} if scaling is None else vars(scaling))):
        raise ConfigurationError(
            f"{refusal} has learned from observations of another scaling (normalize.observation; of a file in"
            f" {NORMALIZE} beside it)"
        )
    weights: Any = parameters["policy"]
    try:
        model.policy.load_state_dict(weights)
    except RuntimeError as error:  # torch names the weights that differ
        raise ConfigurationError(f"{refusal} has other weights (policy, policy_kwargs): {error}") from None
    if scaling is not None:
        statistics = {key: known[key] for key in ("obs_rms", "ret_rms") if key in known}
        vars(scaling).update(deepcopy(statistics))
    return {"from": name, "timesteps": int(data["num_timesteps"])}
