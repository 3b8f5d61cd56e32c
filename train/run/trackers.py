"""Where a run's curves go: TensorBoard always, Weights & Biases and MLflow if the config names them.

All are writers of SB3's logger, so that what algorithms and callbacks log of interventions arrives in each.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from safe_wrappers.errors import ConfigurationError

from ..config.models import ArmConfig
from .folder import TENSORBOARD

Log = Callable[[dict[str, float], int], object]
"""Takes numbers by their names, and the step."""


def run_logger(arm: ArmConfig, seed: int, folder: Path) -> Logger:
    """SB3's logger of a run: TensorBoard, and the arm's trackers, in which a run that goes on is still one run."""
    where = folder / TENSORBOARD
    where.mkdir(parents=True, exist_ok=True)
    settings = {**arm.fingerprint(), "seed": seed, "folder": str(folder.resolve())}
    lasting = {**settings, "total_steps": None}  # it may be raised
    known = hashlib.sha256(json.dumps(lasting, sort_keys=True).encode()).hexdigest()[:16]
    opened = {"wandb": _wandb, "mlflow": _mlflow}
    experiment, name = folder.resolve().parents[1].name, f"{arm.name} seed {seed}"
    trackers = [_Tracker(which, *opened[which](experiment, name, known, settings)) for which in arm.trackers]
    return Logger(str(where), [TensorBoardOutputFormat(str(where)), *trackers])


class _Tracker(KVWriter):
    """A run in one tracker. What fails there is told in a warning, and training goes on."""

    def __init__(self, name: str, log: Log, close: Callable[[], object]) -> None:
        self._name, self._log, self._lost = name, log, False
        self.close = close  # type: ignore[method-assign, assignment]

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """What SB3's logger dumps; numbers that are not finite are left out, as nothing was measured there."""
        numbers = {
            key: float(value)
            for key, value in key_values.items()
            if isinstance(value, int | float | np.number)
            and TENSORBOARD not in (key_excluded.get(key) or ())
            and math.isfinite(value)
        }
        if self._lost or not numbers:
            return
        try:
            self._log(numbers, step)
        except Exception as error:  # whatever a network does: the training is worth more than its curve
            self._lost = True
            warnings.warn(f"{self._name}: what follows is not tracked: {error}", stacklevel=2)


def _wandb(
    experiment: str, name: str, known: str, settings: dict[str, Any]
) -> tuple[Log, Callable[[], object]]:
    run = importlib.import_module("wandb").init(
        project=experiment, name=name, id=known, resume="allow", dir=settings["folder"], config=settings
    )
    # By their own count: a run that goes on from a checkpoint makes some steps again.
    run.define_metric("timesteps")
    run.define_metric("*", step_metric="timesteps")
    return lambda numbers, step: run.log({**numbers, "timesteps": step}), run.finish


def _mlflow(
    experiment: str, name: str, known: str, settings: dict[str, Any]
) -> tuple[Log, Callable[[], object]]:
    mlflow = importlib.import_module("mlflow")
    of, client = mlflow.set_experiment(experiment).experiment_id, mlflow.MlflowClient()
    found = client.search_runs([of], f"tags.known = '{known}'")
    run = (found[0] if found else client.create_run(of, tags={"known": known}, run_name=name)).info.run_id
    for key, value in {} if found else settings.items():
        client.log_param(run, key, value)

    def log(numbers: dict[str, float], step: int) -> None:
        for key, value in numbers.items():
            client.log_metric(run, key, value, step=step)

    return log, lambda: client.set_terminated(run)


def check_trackers(arm: ArmConfig) -> None:
    """Refuses a tracker that is not installed."""
    for name in arm.trackers:
        if importlib.util.find_spec(name) is None:
            raise ConfigurationError(
                f"arms.{arm.name}.trackers: {name} is not installed: pip install 'safe-wrappers[{name}]'"
            )
