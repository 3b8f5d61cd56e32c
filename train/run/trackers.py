"""Where a run's curves go: TensorBoard always, Weights & Biases and MLflow if the config names them.

All are writers of SB3's logger, so that what algorithms and callbacks log of interventions arrives in each.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import tempfile
import time
import uuid
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from safe_wrappers.errors import ConfigurationError, RunStateError

from ..atomic import write_json
from ..checksums import read_facts
from ..config import ArmConfig

TENSORBOARD: Final = "tensorboard"
IDS_FILE: Final = "trackers.json"
"""In a run's folder: by which ids its trackers know it, so that a run that goes on is still one run there."""


class Tracker(KVWriter):
    """A run in one tracker.

    Args:
        arm: The run's arm; its settings are the tracker's.
        seed: Its seed.
        folder: The run's folder, `EXPERIMENT/ARM/seed_N`.

    Raises:
        RunStateError: The tracker refuses it. What fails later is told in a warning, and training goes on.
    """

    def __init__(self, arm: ArmConfig, seed: int, folder: Path) -> None:
        path, kind, self._lost = folder / IDS_FILE, type(self).__name__, False
        ids = read_facts(path, "delete it, and the run is a new one there.")
        known = ids.get(kind)
        try:
            found = self._open(folder.resolve().parents[1].name, arm, seed, folder, known)
        except Exception as error:
            raise RunStateError(
                f"{kind} does not take the run: {error}. Log in there, or work offline (WANDB_MODE=offline,"
                " MLFLOW_TRACKING_URI=sqlite:///mlflow.db), or leave it out of `trackers`."
            ) from error
        if found != known:
            write_json(path, {**ids, kind: found})

    @abstractmethod
    def _open(self, experiment: str, arm: ArmConfig, seed: int, folder: Path, known: str | None) -> str:
        """Begins or goes on with a run; returns its id."""

    @abstractmethod
    def _log(self, numbers: Mapping[str, float], step: int) -> None:
        """Takes numbers by their names."""

    @abstractmethod
    def _film(self, name: str, path: Path, step: int) -> None:
        """Takes a film."""

    @abstractmethod
    def _close(self) -> None:
        """Ends the run."""

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
        if numbers:
            self._unless_lost(self._log, numbers, step)

    def film(self, name: str, path: Path, step: int) -> None:
        """Takes a film (animated WebP) of the policy at this step."""
        self._unless_lost(self._film, name, path, step)

    def close(self) -> None:
        """Ends the run there, until it goes on."""
        self._unless_lost(self._close)

    def _unless_lost(self, call: Callable[..., None], *arguments: Any) -> None:
        if self._lost:
            return
        try:
            call(*arguments)
        except Exception as error:  # whatever a network does: the training is worth more than its curve
            self._lost = True
            warnings.warn(f"{type(self).__name__}: what follows is not tracked: {error}", stacklevel=3)


class Wandb(Tracker):
    """Weights & Biases; `WANDB_MODE=offline` and the like are read by itself."""

    def _open(self, experiment: str, arm: ArmConfig, seed: int, folder: Path, known: str | None) -> str:
        self._wandb = importlib.import_module("wandb")
        chosen = known or uuid.uuid4().hex[:12]
        self._run = self._wandb.init(
            project=experiment,
            group=arm.name,
            name=f"{arm.name} seed {seed}",
            id=chosen,
            resume="allow",
            dir=str(folder),
            config={**arm.fingerprint(), "seed": seed},
        )
        # By their own count: a run that goes on from a checkpoint makes some steps again.
        self._run.define_metric("timesteps")
        self._run.define_metric("*", step_metric="timesteps")
        return chosen

    def _log(self, numbers: Mapping[str, float], step: int) -> None:
        self._run.log({**numbers, "timesteps": step})

    def _film(self, name: str, path: Path, step: int) -> None:
        # As a GIF: it shows no WebP.
        with tempfile.TemporaryDirectory() as folder, Image.open(path) as animation:
            picture = Path(folder) / f"{name}.gif"
            animation.save(picture, save_all=True)
            self._run.log({f"films/{name}": self._wandb.Video(str(picture), format="gif"), "timesteps": step})

    def _close(self) -> None:
        self._run.finish()


class Mlflow(Tracker):
    """MLflow; `MLFLOW_TRACKING_URI` is read by itself."""

    def _open(self, experiment: str, arm: ArmConfig, seed: int, folder: Path, known: str | None) -> str:
        self._mlflow = importlib.import_module("mlflow")
        self._client = self._mlflow.MlflowClient()
        if known is not None:
            self._client.update_run(known, status="RUNNING")
            self._id = known
            return known
        there = self._client.get_experiment_by_name(experiment)
        of = self._client.create_experiment(experiment) if there is None else there.experiment_id
        run = self._client.create_run(of, run_name=f"{arm.name} seed {seed}", tags={"arm": arm.name})
        self._id = str(run.info.run_id)
        for key, value in {**arm.fingerprint(), "seed": seed}.items():
            self._client.log_param(self._id, key, value)
        return self._id

    def _log(self, numbers: Mapping[str, float], step: int) -> None:
        metric, now_ms = self._mlflow.entities.Metric, int(1000 * time.time())
        found = [metric(name, value, now_ms, step) for name, value in numbers.items()]
        self._client.log_batch(self._id, metrics=found)

    def _film(self, name: str, path: Path, step: int) -> None:
        self._client.log_artifact(self._id, str(path), "films")

    def _close(self) -> None:
        self._client.set_terminated(self._id)


_TRACKERS: Final[Mapping[str, type[Tracker]]] = {"wandb": Wandb, "mlflow": Mlflow}


def run_logger(arm: ArmConfig, seed: int, folder: Path) -> Logger:
    """SB3's logger of a run: TensorBoard, and the arm's trackers."""
    where = folder / TENSORBOARD
    where.mkdir(parents=True, exist_ok=True)
    writers: list[KVWriter] = [TensorBoardOutputFormat(str(where))]
    return Logger(str(where), [*writers, *_open(arm, seed, folder)])


def track_film(arm: ArmConfig, seed: int, folder: Path, name: str, path: Path, step: int) -> None:
    """Gives a film of a run's policy to the arm's trackers."""
    for tracker in _open(arm, seed, folder):
        tracker.film(name, path, step)
        tracker.close()


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


def _open(arm: ArmConfig, seed: int, folder: Path) -> list[Tracker]:
    return [_TRACKERS[name](arm, seed, folder) for name in arm.trackers]
