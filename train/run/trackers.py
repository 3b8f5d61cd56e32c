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
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from safe_wrappers.errors import ConfigurationError

from ..config import ArmConfig
from .folder import TENSORBOARD


class Tracker(KVWriter):
    """A run in one tracker; a run that goes on is still one run there.

    What fails later is told in a warning, and training goes on.

    Args:
        arm: The run's arm; its settings are the tracker's.
        seed: Its seed.
        folder: The run's folder, `EXPERIMENT/ARM/seed_N`.
    """

    def __init__(self, arm: ArmConfig, seed: int, folder: Path) -> None:
        settings = {**arm.fingerprint(), "seed": seed}
        settings.pop("total_steps")  # it may be raised
        known = hashlib.sha256(f"{folder.resolve()} {json.dumps(settings, sort_keys=True)}".encode())
        self._lost = False
        self._open(folder, arm, f"{arm.name} seed {seed}", known.hexdigest()[:16], settings)

    @abstractmethod
    def _open(self, folder: Path, arm: ArmConfig, name: str, known: str, settings: dict[str, Any]) -> None:
        """Begins a run, or goes on with the one that is known by this text."""

    @abstractmethod
    def _log(self, numbers: Mapping[str, float], step: int) -> None:
        """Takes numbers by their names."""

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
            warnings.warn(f"{type(self).__name__}: what follows is not tracked: {error}", stacklevel=2)


class Wandb(Tracker):
    """Weights & Biases; `WANDB_MODE=offline` and the like are read by itself."""

    def _open(self, folder: Path, arm: ArmConfig, name: str, known: str, settings: dict[str, Any]) -> None:
        self._run = importlib.import_module("wandb").init(
            project=folder.resolve().parents[1].name,
            group=arm.name,
            name=name,
            id=known,
            resume="allow",
            dir=str(folder),
            config=settings,
        )
        # By their own count: a run that goes on from a checkpoint makes some steps again.
        self._run.define_metric("timesteps")
        self._run.define_metric("*", step_metric="timesteps")

    def _log(self, numbers: Mapping[str, float], step: int) -> None:
        self._run.log({**numbers, "timesteps": step})

    def close(self) -> None:
        """Ends the run there, until it goes on."""
        self._run.finish()


class Mlflow(Tracker):
    """MLflow; `MLFLOW_TRACKING_URI` is read by itself."""

    def _open(self, folder: Path, arm: ArmConfig, name: str, known: str, settings: dict[str, Any]) -> None:
        mlflow = importlib.import_module("mlflow")
        mlflow.set_experiment(folder.resolve().parents[1].name)
        self._client = mlflow.MlflowClient()
        of = mlflow.get_experiment_by_name(folder.resolve().parents[1].name).experiment_id
        found = self._client.search_runs([of], f"tags.known = '{known}'")
        run = found[0] if found else self._client.create_run(of, tags={"known": known}, run_name=name)
        self._id = run.info.run_id
        for key, value in {} if found else settings.items():
            self._client.log_param(self._id, key, value)

    def _log(self, numbers: Mapping[str, float], step: int) -> None:
        for key, value in numbers.items():
            self._client.log_metric(self._id, key, value, step=step, synchronous=False)

    def close(self) -> None:
        """Ends the run there, until it goes on."""
        self._client.set_terminated(self._id)


_TRACKERS: Final[Mapping[str, type[Tracker]]] = {"wandb": Wandb, "mlflow": Mlflow}


def run_logger(arm: ArmConfig, seed: int, folder: Path) -> Logger:
    """SB3's logger of a run: TensorBoard, and the arm's trackers."""
    where = str(folder / TENSORBOARD)
    (folder / TENSORBOARD).mkdir(parents=True, exist_ok=True)
    trackers = [_TRACKERS[name](arm, seed, folder) for name in arm.trackers]
    return Logger(where, [TensorBoardOutputFormat(where), *trackers])


def check_trackers(arm: ArmConfig) -> None:
    """Refuses a tracker that is not installed.

    Raises:
        ConfigurationError: It is not; says how to install it.
    """
    for name in arm.trackers:
        if importlib.util.find_spec(name) is None:
            raise ConfigurationError(
                f"arms.{arm.name}.trackers: {name} is not installed: pip install 'safe-wrappers[{name}]'"
            )
