"""What the filter did and what the task cost, per step so far and per episode, in info and in a CSV file."""

from __future__ import annotations

import csv
import io
import math
import os
from pathlib import Path
from typing import Any, ClassVar, Final, SupportsFloat

import gymnasium as gym
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.stack import Layer, refuse_order
from safe_wrappers.wrappers.common.not_judged import NOT_JUDGED

COLUMNS: Final = (
    "length",
    "return",
    "intervention_rate",
    "correction_mean",
    "correction_p95",
    "infeasible",
    "fallback",
    "nonfinite",
    "unsafe",
    "lease_expired",
    "lease_refused",
    "lease_braking",
    "margin_min",
    "violations",
    "cost",
    "cost_substep",
    "goals_reached",
    "spin_outs",
    "success",
    "collisions",
    "seen",
    "expiries",
)
"""The CSV file's columns. Cells stay empty where the task or the stack does not report what they hold."""


_FLAGS: Final = {
    "intervened": keys.CBF_INTERVENED,
    "infeasible": keys.CBF_INFEASIBLE,
    "fallback": keys.CBF_FALLBACK,
    "nonfinite": keys.CBF_NONFINITE,
    "unsafe": keys.CBF_UNSAFE,
    "lease_expired": keys.LEASE_EXPIRED,
    "lease_refused": keys.LEASE_REFUSED,
    "lease_braking": keys.LEASE_BRAKING,
}
"""Counted: steps at which a flag was up."""
_OF_THE_TASK: Final = ("violations", keys.COST, keys.COST_SUBSTEP, "spin_outs", "collisions")
_RUNNING_SOURCES: Final = (
    keys.CBF_INTERVENED,
    keys.CBF_CORRECTION,
    keys.CBF_INFEASIBLE,
    keys.CBF_FALLBACK,
    keys.CBF_MARGIN,
    keys.COST,
    keys.COST_SUBSTEP,
)
"""Of each key of `interventions.RUNNING`, what it is made from."""


class RecordInterventions(
    gym.Wrapper[Any, Any, Any, Any],
    gym.utils.RecordConstructorArgs,
):
    """Counts interventions, corrections and costs; changes neither actions, rewards nor observations.

    Put it outside the filter, `LeaseExpiry`, `TeleopChannel` and `OcclusionPenalty`, and inside `ChunkHandover` and
    SB3's `Monitor`; other orders of our own wrappers are refused (`stack.py`).

    **What nobody reported is not zero.** Without a filter inside (the unfiltered arm of a comparison) there are no
    `cbf/*` keys, and many tasks report no `cost`. What would be made of them is NaN in the running keys, missing
    in the episode's summary, and an empty cell in the file. The same holds for a 0 that was not reported at every
    step; a count above 0 is given, as a lower bound. `CostFunction` gives a cost to a task that has none.

    At every step `info` gains the keys of `safe_wrappers.info.RUNNING` (float64, the episode so
    far), and at an episode's last step `info["interventions"]`, a dict:

    - `length`, `return` (of the task: what an `OcclusionPenalty` or `AdaptionPenalty` inside has taken off is added
      back);
    - `intervention_rate`: intervened steps / length;
    - `correction_mean`, `correction_p95`: over all steps of the episode, also those with no correction;
    - `infeasible`, `fallback`, `nonfinite`, `unsafe`: numbers of steps;
    - `lease_expired`, `lease_refused`, `lease_braking`: numbers of steps, with a `LeaseExpiry` inside;
    - `margin_min`: the smallest finite `cbf/margin`;
    - `violations`: steps with `cost` or `cost_substep` above 0;
    - `cost`, `cost_substep`: sums;
    - `spin_outs`: steps with `spin_out` above 0;
    - `collisions`: how many began;
    - `seen`: share of time that a tracked thing was seen, mean over the tracks, and `expiries`: how often the
      permission to rely on one ran out, with an `OcclusionPenalty` inside;
    - `goals_reached` and `success` when the task reports `goals_reached`, and `success` or `is_success`.

    Args:
        env: The env to record.
        path: A CSV file that gains one row per finished episode. An existing file is continued; a last line
            that a killed process left half-written is removed first. Give every env its own file.

    Raises:
        ConfigurationError: `path` is a folder, or a file with other columns; or a `ChunkHandover` inside.

    Example:
        >>> import gymnasium as gym
        >>> from safe_wrappers.wrappers.record_interventions import RecordInterventions
        >>> env = RecordInterventions(gym.make("Pendulum-v1", max_episode_steps=3))
        >>> _ = env.reset(seed=0)
        >>> for _ in range(3):
        ...     _, _, _, _, info = env.step(env.action_space.low)
        >>> print(list(info["interventions"]), info["interventions/cost"])  # no filter, and a task without a cost
        ['length', 'return'] nan

    Change log:
        * v0.1.0: added.
    """

    layer: ClassVar = Layer.RECORDER

    _expired: Any
    """Permissions that had run out at the step before; None: nothing is tracked."""

    def __init__(self, env: gym.Env[Any, Any], path: str | os.PathLike[str] | None = None) -> None:
        refuse_order(env, self.layer, type(self).__name__)
        text = None if path is None else os.fspath(path)
        if text is not None:
            _continue_file(Path(text))
        gym.utils.RecordConstructorArgs.__init__(self, path=text)
        gym.Wrapper.__init__(self, env)
        self.path = text
        self._clear()

    @property
    def filter_time_us(self) -> float | None:
        """Mean time of one filter call in microseconds; None with no filter inside or before its first call.

        An attribute, because wall-clock values in `info` would make two identical runs differ.
        """
        if not self.env.has_wrapper_attr("filter_seconds"):
            return None
        calls = int(self.env.get_wrapper_attr("filter_calls"))
        return 1e6 * float(self.env.get_wrapper_attr("filter_seconds")) / calls if calls else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts a new episode's counts: 0 in info of what this reset's info has, NaN of what it lacks.

        Seed and options pass through untouched.
        """
        self._clear()
        observation, info = self.env.reset(seed=seed, options=options)
        self._expired = info.get(keys.OCCLUSION_EXPIRED)
        sources = zip(keys.RUNNING, _RUNNING_SOURCES, strict=True)
        info.update({key: 0.0 if source in info else NOT_JUDGED for key, source in sources})
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Steps the env and adds the running counts, and the summary at the episode's end, to its info."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._count(float(reward), info)
        info.update(self._running())
        if terminated or truncated:
            summary = self._summary()
            info[keys.EPISODE_SUMMARY] = summary
            if self.path is not None:
                _append_row(Path(self.path), summary)
        return observation, reward, terminated, truncated, info

    def _clear(self) -> None:
        self._steps = 0
        self._return = 0.0
        self._corrections: list[float] = []
        self._totals: dict[str, tuple[int | float, int]] = {}
        self._margin_min = math.inf
        self._task: dict[str, int | float | bool] = {}
        self._seen = 0.0
        self._expired = None

    def _count(self, reward: float, info: dict[str, Any]) -> None:
        self._steps += 1
        penalties = info.get(keys.OCCLUSION_PENALTY, 0.0) + info.get(keys.ADAPTION_PENALTY, 0.0)
        self._return += reward + float(penalties)
        for name, key in _FLAGS.items():
            if key in info:
                self._add(name, bool(info[key]))
        if keys.CBF_CORRECTION in info:
            self._corrections.append(float(info[keys.CBF_CORRECTION]))
            self._add("correction", self._corrections[-1])
        margin = float(info.get(keys.CBF_MARGIN, math.inf))
        if math.isfinite(margin):
            self._margin_min = min(self._margin_min, margin)
        costs = {name: float(info.get(name, math.nan)) for name in (keys.COST, keys.COST_SUBSTEP)}
        costs = {name: cost for name, cost in costs.items() if not math.isnan(cost)}
        for name, cost in costs.items():
            self._add(name, cost)
        if costs:
            self._add("violations", max(costs.values()) > 0.0)
        if keys.SPIN_OUT in info:
            self._add("spin_outs", bool(info[keys.SPIN_OUT] > 0.0))
        if keys.COLLISIONS in info:
            self._add("collisions", int(info[keys.COLLISIONS]))
        if "goals_reached" in info:
            self._task["goals_reached"] = int(info["goals_reached"])
        if keys.OCCLUSION_VISIBLE in info:
            self._count_sight(info)
        success = info.get("success", info.get("is_success"))
        if success is not None:
            self._task["success"] = self._task.get("success", False) or bool(success)

    def _add(self, name: str, value: int | float) -> None:
        total, reports = self._totals.get(name, (0, 0))
        self._totals[name] = total + value, reports + 1

    def _total(self, name: str) -> int | float | None:
        """The episode's sum so far; None if it would be a 0 that was not reported at every step."""
        total, reports = self._totals.get(name, (0, 0))
        return total if total or reports == self._steps else None

    def _mean(self, name: str) -> float | None:
        total = self._total(name)
        return None if total is None else total / self._steps

    def _count_sight(self, info: dict[str, Any]) -> None:
        self._seen += float(np.mean(info[keys.OCCLUSION_VISIBLE]))
        self._task["seen"] = self._seen / self._steps
        expired = np.asarray(info[keys.OCCLUSION_EXPIRED])
        before: Any = expired if self._expired is None else self._expired
        self._task["expiries"] = self._task.get("expiries", 0) + int((expired & ~before).sum())
        self._expired = expired

    def _running(self) -> dict[str, float]:
        values = (
            self._mean("intervened"),
            self._mean("correction"),
            self._total("infeasible"),
            self._total("fallback"),
            self._finite_margin(),
            self._total(keys.COST),
            self._total(keys.COST_SUBSTEP),
        )
        return {
            key: NOT_JUDGED if value is None else float(value)
            for key, value in zip(keys.RUNNING, values, strict=True)
        }

    def _summary(self) -> dict[str, int | float | bool]:
        all_corrections = len(self._corrections) == self._steps
        values = {
            "length": self._steps,
            "return": self._return,
            "intervention_rate": self._mean("intervened"),
            "correction_mean": self._mean("correction"),
            "correction_p95": float(np.percentile(self._corrections, 95)) if all_corrections else None,
            **{name: self._total(name) for name in _FLAGS if name != "intervened"},
            "margin_min": self._finite_margin(),
            **{name: self._total(name) for name in _OF_THE_TASK},
            **self._task,
        }
        return {name: value for name, value in values.items() if value is not None}

    def _finite_margin(self) -> float | None:
        return self._margin_min if math.isfinite(self._margin_min) else None


def read_episodes(path: str | os.PathLike[str]) -> list[dict[str, float]]:
    """Reads back a CSV file of `RecordInterventions`; a half-written last line is left out.

    Args:
        path: The file.

    Returns:
        One dict per episode; empty cells (what was not reported) are left out of it.
    """
    rows = csv.DictReader(io.StringIO(_whole_lines(Path(path).read_bytes()).decode()))
    return [{key: float(value) for key, value in row.items() if value != ""} for row in rows]


def _whole_lines(data: bytes) -> bytes:
    # A number cut short still reads as a number, so only the newline tells that a line is whole.
    return data[: data.rfind(b"\n") + 1]


def _continue_file(path: Path) -> None:
    if path.is_dir():
        raise ConfigurationError(
            f"RecordInterventions: path {str(path)!r} is a folder; give a file name in it."
        )
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
        raise ConfigurationError(
            f"RecordInterventions: {str(path)!r} exists and has other columns ({header!r}; expected"
            f" {','.join(COLUMNS)!r}). Give another path, or move that file away."
        )


def _append_row(path: Path, row: dict[str, int | float | bool]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
    if not path.exists() or path.stat().st_size == 0:
        writer.writeheader()
    # Bools as 0 and 1, so that every cell reads back as a number.
    writer.writerow({key: int(value) if isinstance(value, bool) else value for key, value in row.items()})
    with path.open("a", newline="") as file:
        file.write(text.getvalue())  # one write: a kill leaves at most one half line, at the end
