"""What happens beside the learning of one run: episode rows, progress, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from stable_baselines3.common.callbacks import BaseCallback

from safe_wrappers import interventions as keys
from safe_wrappers.wrappers.record_interventions import COLUMNS

from .tables import append_row, read_rows, write_rows

EPISODE_COLUMNS: Final = ("timesteps", "env", *COLUMNS)


class EpisodeRows(BaseCallback):
    """Adds a row to a CSV file for each training episode, with the run's step count at its end.

    When a run goes on from a checkpoint, rows of later steps are cut first: those steps will be made again.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_training_start(self) -> None:
        kept = [row for row in read_rows(self.path) if row["timesteps"] <= self.num_timesteps]
        write_rows(self.path, EPISODE_COLUMNS, kept)

    def _on_step(self) -> bool:
        for env, info in enumerate(self.locals["infos"]):
            if keys.EPISODE_SUMMARY in info:
                row = {"timesteps": self.num_timesteps, "env": env, **info[keys.EPISODE_SUMMARY]}
                append_row(self.path, EPISODE_COLUMNS, row)
        return True


class ProgressCallback(BaseCallback):
    """Reports the step count, at most twice a second."""

    def __init__(self, report: Callable[[int], None]) -> None:
        super().__init__()
        self.report = report
        self._next = 0.0

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now >= self._next:
            self._next = now + 0.5
            self.report(self.num_timesteps)
        return True

    def _on_training_end(self) -> None:
        self.report(self.num_timesteps)


class CheckpointCallback(BaseCallback):
    """Saves between two rollouts, when the buffer is empty and the last update is done."""

    def __init__(self, every: int, save: Callable[[], None]) -> None:
        super().__init__()
        self.every = every
        self.save = save

    def _on_training_start(self) -> None:
        self._last = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._last >= self.every:
            self._last = self.num_timesteps
            self.save()

    def _on_step(self) -> bool:
        return True
