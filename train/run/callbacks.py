"""What happens beside the learning of one run: episode rows, progress, checkpoints, an early end."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Final

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from safe_wrappers import info as keys
from safe_wrappers.wrappers.record_interventions import COLUMNS

from ..tables import append_row, read_rows, write_rows

EPISODE_COLUMNS: Final = ("timesteps", "env", *COLUMNS)
_LAST_EPISODES: Final = 100
_PATIENCE_S: Final = 5.0
"""A rollout that is not over so long after a stop was asked for is given up."""
_SCALING: Final[tuple[str, ...]] = ("obs_rms", "ret_rms", "returns")
"""What VecNormalize learns."""


class EpisodeRows(BaseCallback):
    """Adds a row to a CSV file for each training episode, with the run's step count at its end.

    When a run goes on from a checkpoint, rows of later steps are cut first: those steps will be made again.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_training_start(self) -> None:
        begun = self.num_timesteps > 0
        kept = (
            [row for row in read_rows(self.path) if row["timesteps"] <= self.num_timesteps] if begun else []
        )
        write_rows(self.path, EPISODE_COLUMNS, kept)

    def _on_step(self) -> bool:
        for env, info in enumerate(self.locals["infos"]):
            if keys.EPISODE_SUMMARY in info:
                row = {"timesteps": self.num_timesteps, "env": env, **info[keys.EPISODE_SUMMARY]}
                append_row(self.path, EPISODE_COLUMNS, row)
        return True


class ProgressCallback(BaseCallback):
    """Reports the step count, and what the last episodes came to, at most twice a second.

    Args:
        steps: Told the step count.
        figures: Told by name: `return` and, with a filter, `changed` (share of steps), both over the last 100
            episodes; `violations`, the steps in violation of all episodes of this run and process, or "not judged".
        filtered: There is a filter.
    """

    def __init__(
        self, steps: Callable[[int], None], figures: Callable[[Mapping[str, str]], None], filtered: bool
    ) -> None:
        super().__init__()
        self.steps = steps
        self.figures = figures
        self.filtered = filtered
        self._next = 0.0
        self._episodes: deque[Mapping[str, Any]] = deque(maxlen=_LAST_EPISODES)
        self._violations: int | None = None

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if keys.EPISODE_SUMMARY in info:
                self._episodes.append(info[keys.EPISODE_SUMMARY])
                if keys.COST in info or keys.COST_SUBSTEP in info:
                    self._violations = (self._violations or 0) + info[keys.EPISODE_SUMMARY]["violations"]
        now = time.monotonic()
        if now >= self._next:
            self._next = now + 0.5
            self.steps(self.num_timesteps)
            if self._episodes:
                self.figures(self._figures())
        return True

    def _on_training_end(self) -> None:
        self.steps(self.num_timesteps)

    def _figures(self) -> dict[str, str]:
        values = {
            "return": f"{np.mean([episode['return'] for episode in self._episodes]):.1f}",
            "violations": "not judged" if self._violations is None else f"{self._violations:,}",
        }
        if self.filtered:
            rates, lengths = (
                [episode[key] for episode in self._episodes] for key in ("intervention_rate", "length")
            )
            values["changed"] = f"{100 * np.average(rates, weights=lengths):.1f} %"
        return values


class CheckpointCallback(BaseCallback):
    """Saves between two rollouts, when the buffer is empty and the last update is done."""

    def __init__(self, every: int, save: Callable[[], object]) -> None:
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


class TrainingStopped(Exception):  # noqa: N818 (no error: it ends `learn`)
    """Training ended on request; the model stands at `num_timesteps` as after its last update."""

    def __init__(self, reached: int) -> None:
        super().__init__(reached)
        self.reached = reached
        """Steps that were made; those beyond the model's `num_timesteps` are lost."""


class StopCallback(BaseCallback):
    """Ends training on request.

    It waits for the end of the rollout and its update, which loses nothing. A rollout that takes longer than
    5 s is given up: an on-policy algorithm is put back to the rollout's start, with the observation scaling of that
    time, and those steps are made anew; an off-policy one, which has stored them, loses this last step only.

    Args:
        asked: Whether to stop.

    Raises:
        TrainingStopped: Out of `learn`; the model can be saved.
    """

    def __init__(self, asked: Callable[[], bool]) -> None:
        super().__init__()
        self.asked = asked
        self._asked_at: float | None = None

    def _on_rollout_start(self) -> None:
        if self.asked():
            raise TrainingStopped(self.model.num_timesteps)
        self._start = self.model.num_timesteps
        scaling = self.model.get_vec_normalize_env()
        if scaling is not None:
            self._scaling = deepcopy(
                {name: vars(scaling)[name] for name in _SCALING if name in vars(scaling)}
            )

    def _on_step(self) -> bool:
        if self.asked():
            now = time.monotonic()
            self._asked_at = now if self._asked_at is None else self._asked_at
            if now - self._asked_at >= _PATIENCE_S:
                self._give_up_rollout()
        return True

    def _give_up_rollout(self) -> None:
        reached = self.model.num_timesteps
        if isinstance(self.model, OffPolicyAlgorithm):
            self.model.num_timesteps -= self.model.n_envs  # SB3 stores a step after its callbacks
        else:
            self.model.num_timesteps = self._start
            scaling = self.model.get_vec_normalize_env()
            if scaling is not None:
                vars(scaling).update(self._scaling)
        raise TrainingStopped(reached)
