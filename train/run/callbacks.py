"""What happens beside the learning of one run: episode rows, progress, checkpoints, an early end."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from stable_baselines3.common.callbacks import BaseCallback

from safe_wrappers import info as keys
from safe_wrappers.wrappers.recording import COLUMNS

from ..files import append_row, read_rows, write_rows
from ..processes import Progress, RunStoppedError

EPISODE_COLUMNS: Final = ("timesteps", "env", *COLUMNS)


class EpisodeRows(BaseCallback):
    """Adds a row to a CSV file for each training episode, with the run's step count at its end.

    When a run goes on from a checkpoint, rows of later steps are cut first: those steps will be made again.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_training_start(self) -> None:
        rows = read_rows(self.path) if self.num_timesteps > 0 else []
        kept = [row for row in rows if row["timesteps"] <= self.num_timesteps]
        write_rows(self.path, EPISODE_COLUMNS, kept)

    def _on_step(self) -> bool:
        for env, info in enumerate(self.locals["infos"]):
            if keys.EPISODE_SUMMARY in info:
                row = {"timesteps": self.num_timesteps, "env": env, **info[keys.EPISODE_SUMMARY]}
                append_row(self.path, EPISODE_COLUMNS, row)
        return True


class CheckpointCallback(BaseCallback):
    """Saves between two rollouts, when the buffer is empty and the last update is done: now and then, and to stop.

    Reports the step count, at most twice a second.

    SB3's own callback saves in the midst of a rollout, from where nothing goes on bit for bit.

    Args:
        every: Steps.
        save: Saves.
        progress: Where to report to, and whether the run is to end.

    Raises:
        RunStoppedError: Out of `learn`, when it is to end.
    """

    def __init__(self, every: int, save: Callable[[], object], progress: Progress) -> None:
        super().__init__()
        self.every = every
        self.save = save
        self.progress = progress
        self._next = 0.0

    def _on_training_start(self) -> None:
        self._last = self.num_timesteps

    def _on_rollout_start(self) -> None:
        stopping = self.progress.stopping()
        if self.num_timesteps - self._last >= self.every or (stopping and self.num_timesteps > 0):
            self._last = self.num_timesteps
            self.save()
        if stopping:
            raise RunStoppedError(f"stopped; goes on from step {self.num_timesteps:,}")

    def _on_step(self) -> bool:
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + 0.5
            self.progress.steps(self.num_timesteps)
        return True

    def _on_training_end(self) -> None:
        self.progress.steps(self.num_timesteps)
