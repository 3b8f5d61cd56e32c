"""What the filter did and what the task cost, per step so far and per episode, in info and in a CSV file."""

import csv
import io
import math
import os
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Reset, Step

COLUMNS: Final = ("length", "return", *(figure.name for figure in keys.EPISODE))
"""The CSV file's columns. Cells stay empty where the task or the stack does not report what they hold."""


class _Tally:
    """A figure of the episode so far: the numbers that were reported, of which NaN is none."""

    def __init__(self, figure: keys.EpisodeFigure) -> None:
        self.figure = figure
        of = [keys.KEYS[name] for name in figure.of]
        self._read = [(key.name, key.number if key.shape else float) for key in of]
        self._counts = of[0].dtype == "int64"
        self._numbers: list[float] = []
        self._before: Any = None

    def reset(self, info: dict[str, Any]) -> None:
        """Of entries that are True at the reset no onset is counted."""
        self._before = info.get(self.figure.of[0])

    def add(self, info: dict[str, Any]) -> None:
        """Take a step's number."""
        found = [n for name, read in self._read if name in info and (n := read(info[name])) == n]
        if not found:
            return
        number = found[0]
        if self.figure.how == "count" and not self._counts:
            number = max(found) > 0.0
        elif self.figure.how == "onsets":
            now = np.asarray(info[self.figure.of[0]])
            number = 0 if self._before is None else int((now & ~self._before).sum())
            self._before = now
        self._numbers.append(number)

    def value(self, steps: int) -> int | float | None:
        """The figure after so many steps; None if nobody reported it, or for a 0 that is not of every step."""
        numbers, how = self._numbers, self.figure.how
        if how == "min":
            return min(filter(math.isfinite, numbers), default=None)
        if how == "last":
            return int(numbers[-1]) if numbers else None
        if how == "any":
            return bool(max(numbers)) if numbers else None
        if how == "p95":
            return float(np.percentile(numbers, 95)) if len(numbers) == steps else None
        total = sum(numbers) if how in ("sum", "mean") else int(sum(numbers))
        if not total and len(numbers) < steps:
            return None
        return total / steps if how == "mean" else total


class RecordInterventions(LayerWrapper):
    """Counts interventions, corrections and costs; changes neither actions, rewards nor observations.

    Put it outside the filter, `LeaseExpiry`, `TeleopChannel` and `OcclusionPenalty`, and inside `ChunkHandover` and
    SB3's `Monitor`. At an episode's last step `info` gains `info["interventions"]`, a dict: `length`, `return` (of
    the task: penalties that a wrapper inside has taken off are added back), and the figures of
    `safe_wrappers.info.EPISODE`. A mean is over all steps of the episode, `margin_min` the smallest finite
    `cbf/margin`.

    What nobody reported is not zero: it is missing in the summary, and an empty cell in the file. The same holds for
    a 0 that was not reported at every step; a count above 0 is a lower bound.

    Args:
        env: The env to record.
        path: A CSV file, one for each env, that gains one row per finished episode; an existing one is continued.

    Raises:
        ConfigurationError: `path` is a folder, or a file with other columns; or a `ChunkHandover` inside.

    Example:
        >>> import gymnasium as gym
        >>> from safe_wrappers.wrappers.record_interventions import RecordInterventions
        >>> env = RecordInterventions(gym.make("Pendulum-v1", max_episode_steps=3))
        >>> _ = env.reset(seed=0)
        >>> for _ in range(3):
        ...     _, _, _, _, info = env.step(env.action_space.low)
        >>> print(list(info["interventions"]))  # no filter, and a task without a cost
        ['length', 'return']
    """

    layer: ClassVar = Layer.RECORDER

    def __init__(self, env: Env, path: str | os.PathLike[str] | None = None) -> None:
        LayerWrapper.__init__(self, env)
        text = None if path is None else os.fspath(path)
        if text is not None:
            _continue_file(Path(text))
        self._record({"path": text})
        self.path = text
        self._clear()

    @property
    def filter_time_us(self) -> float | None:
        """Mean time of one filter call, microseconds; None with no filter inside or before its first call."""
        if not self.env.has_wrapper_attr("filter_seconds"):
            return None
        calls = int(self.env.get_wrapper_attr("filter_calls"))
        return 1e6 * float(self.env.get_wrapper_attr("filter_seconds")) / calls if calls else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Start a new episode's counts."""
        self._clear()
        observation, info = self.env.reset(seed=seed, options=options)
        for tally in self._tallies:
            tally.reset(info)
        return observation, info

    def step(self, action: Any) -> Step:
        """Step the env; its info gains the summary at the episode's end."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        self._steps += 1
        penalties = info.get(keys.OCCLUSION_PENALTY, 0.0) + info.get(keys.ADAPTION_PENALTY, 0.0)
        self._return += float(reward) + float(penalties)
        for tally in self._tallies:
            tally.add(info)
        if terminated or truncated:
            figures = {tally.figure.name: tally.value(self._steps) for tally in self._tallies}
            summary = {"length": self._steps, "return": self._return}
            summary |= {name: value for name, value in figures.items() if value is not None}
            info[keys.EPISODE_SUMMARY] = summary
            if self.path is not None:
                _append_row(Path(self.path), summary)
        return observation, reward, terminated, truncated, info

    def _clear(self) -> None:
        self._steps, self._return = 0, 0.0
        self._tallies = [_Tally(figure) for figure in keys.EPISODE]


def read_episodes(path: str | os.PathLike[str]) -> list[dict[str, float]]:
    """Read a CSV file of `RecordInterventions`: one dict per whole line, without the cells that are empty."""
    rows = csv.DictReader(io.StringIO(_whole_lines(Path(path).read_bytes()).decode()))
    return [{key: float(value) for key, value in row.items() if value != ""} for row in rows]


def _whole_lines(data: bytes) -> bytes:
    # A number cut short still reads as a number, so only the newline tells that a line is whole.
    return data[: data.rfind(b"\n") + 1]


def _continue_file(path: Path) -> None:
    if path.is_dir():
        raise ConfigurationError(f"RecordInterventions: {str(path)!r} is a folder; give a file name in it.")
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        return
    data = path.read_bytes()
    whole = _whole_lines(data)
    if len(whole) < len(data):
        with path.open("rb+") as file:
            file.truncate(len(whole))
    header = whole.split(b"\n", 1)[0].decode(errors="replace").strip()
    if header and header != ",".join(COLUMNS):
        columns = f"has other columns ({header!r}; expected {','.join(COLUMNS)!r})"
        raise ConfigurationError(f"RecordInterventions: {str(path)!r} {columns}. Give another path.")


def _append_row(path: Path, row: dict[str, int | float | bool]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
    if not path.exists() or path.stat().st_size == 0:
        writer.writeheader()
    # Bools as 0 and 1, so that every cell reads back as a number.
    writer.writerow({key: int(value) if isinstance(value, bool) else value for key, value in row.items()})
    with path.open("a", newline="") as file:
        file.write(text.getvalue())  # one write: a kill leaves at most one half line, at the end
