"""From a run's folder to a policy that acts."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

from safe_wrappers.errors import ConfigurationError, RunStateError

from ..config.stored import stored_arm
from ..run.checkpoint import latest_checkpoint
from ..run.policy import TrainedPolicy
from ..run.training import CHECKPOINTS, RUN_FILE


def load_policy(run: Path | str) -> TrainedPolicy:
    """Load the policy of a run's newest checkpoint, of one that is not finished too.

    Args:
        run: The run's folder, `runs/NAME/ARM/seed_N`.

    Returns:
        The policy, a function of an observation; its `make_env` has the env that it was trained in.

    Raises:
        ConfigurationError: The folder holds no run, or no checkpoint.
        RunStateError: Its `run.json` is unreadable, or all its checkpoints are damaged.
    """
    folder = Path(run)
    file = folder / RUN_FILE
    if not file.is_file():
        raise ConfigurationError(
            f"{str(folder)!r} is no run's folder (it has no {RUN_FILE}): give runs/NAME/ARM/seed_N"
        )
    try:
        stored = json.loads(file.read_text())
        name, fingerprint = stored["arm"], stored["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise RunStateError(f"{str(file)!r} is unreadable: {error!r}") from error
    arm = stored_arm(name, fingerprint)
    checkpoint = latest_checkpoint(folder / CHECKPOINTS, lambda line: warnings.warn(line, stacklevel=3))
    if checkpoint is None:
        raise ConfigurationError(f"{str(folder)!r} has no checkpoint yet")
    return TrainedPolicy(arm, checkpoint)
