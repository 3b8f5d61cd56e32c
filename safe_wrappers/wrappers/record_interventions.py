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

from safe_wrappers import interventions as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.stack import Layer, refuse_order

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
"""The CSV file's columns. Those from `goals_reached` on stay empty for tasks and stacks that do not report them."""


_COUNTED: Final = {
    "infeasible": keys.CBF_INFEASIBLE,
    "fallback": keys.CBF_FALLBACK,
    "nonfinite": keys.CBF_NONFINITE,
    "unsafe": keys.CBF_UNSAFE,
    "lease_expired": keys.LEASE_EXPIRED,
    "lease_refused": keys.LEASE_REFUSED,
    "lease_braking": keys.LEASE_BRAKING,
}
"""Steps at which a flag was up, by the summary's name for it."""


class RecordInterventions(
    gym.Wrapper[Any, Any, Any, Any],
    gym.utils.RecordConstructorArgs,
):
    """Counts interventions, corrections and costs; changes neither actions, rewards nor observations.

    Put it outside the filter, `LeaseExpiry`, `TeleopChannel` and `OcclusionPenalty`, and inside `ChunkHandover` and
    SB3's `Monitor`; other orders of our own wrappers are refused (`wrappers/stack.py`). Without a filter
    inside (the unfiltered arm of a comparison) the missing `cbf/*` keys count as zero, and so do `cost` and
    `cost_substep` of a task that has none.

    At every step `info` gains the keys of `safe_wrappers.interventions.RUNNING` (float64, the episode so
    far), and at an episode's last step `info["interventions"]`, a dict:

    - `length`, `return` (of the task: what an `OcclusionPenalty` or `AdaptionPenalty` inside has taken off is added
      back);
    - `intervention_rate`: intervened steps / length;
    - `correction_mean`, `correction_p95`: over all steps of the episode, also those with no correction;
    - `infeasible`, `fallback`, `nonfinite`, `unsafe`: numbers of steps;
    - `lease_expired`, `lease_refused`, `lease_braking`: numbers of steps, all 0 without `LeaseExpiry`;
    - `margin_min`: the smallest finite `cbf/margin` (0 when there was none);
    - `violations`: steps with `cost` or `cost_substep` above 0;
    - `cost`, `cost_substep`: sums;
    - `spin_outs`: steps with `spin_out` above 0, when the task reports it;
    - `collisions`: how many began, when the task reports it;
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
        >>> info["interventions"]["length"], info["interventions"]["intervention_rate"]
        (3, 0.0)

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
        """Starts a new episode's counts, all zero in info; seed and options pass through untouched."""
        self._clear()
        observation, info = self.env.reset(seed=seed, options=options)
        self._expired = info.get(keys.OCCLUSION_EXPIRED)
        info.update(dict.fromkeys(keys.RUNNING, 0.0))
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
        self._return = 0.0
        self._corrections: list[float] = []
        self._correction_sum = 0.0
        self._intervened = 0
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._margin_min = math.inf
        self._violations = 0
        self._cost = 0.0
        self._cost_substep = 0.0
        self._task: dict[str, int | float | bool] = {}
        self._seen = 0.0
        self._expired = None

    def _count(self, reward: float, info: dict[str, Any]) -> None:
        penalties = info.get(keys.OCCLUSION_PENALTY, 0.0) + info.get(keys.ADAPTION_PENALTY, 0.0)
        self._return += reward + float(penalties)
        correction = float(info.get(keys.CBF_CORRECTION, 0.0))
        self._corrections.append(correction)
        self._correction_sum += correction
        self._intervened += bool(info.get(keys.CBF_INTERVENED, False))
        for name in self._counts:
            self._counts[name] += bool(info.get(_COUNTED[name], False))
        margin = float(info.get(keys.CBF_MARGIN, math.inf))
        if math.isfinite(margin):
            self._margin_min = min(self._margin_min, margin)
        cost = float(info.get(keys.COST, 0.0))
        cost_substep = float(info.get(keys.COST_SUBSTEP, 0.0))
        self._violations += cost > 0 or cost_substep > 0
        self._cost += cost
        self._cost_substep += cost_substep
        if "goals_reached" in info:
            self._task["goals_reached"] = int(info["goals_reached"])
        if keys.SPIN_OUT in info:
            self._task["spin_outs"] = self._task.get("spin_outs", 0) + bool(info[keys.SPIN_OUT] > 0.0)
        if keys.COLLISIONS in info:
            self._task["collisions"] = self._task.get("collisions", 0) + int(info[keys.COLLISIONS])
        if keys.OCCLUSION_VISIBLE in info:
            self._count_sight(info)
        success = info.get("success", info.get("is_success"))
        if success is not None:
            self._task["success"] = self._task.get("success", False) or bool(success)

    def _count_sight(self, info: dict[str, Any]) -> None:
        self._seen += float(np.mean(info[keys.OCCLUSION_VISIBLE]))
        self._task["seen"] = self._seen / len(self._corrections)
        expired = np.asarray(info[keys.OCCLUSION_EXPIRED])
        before: Any = expired if self._expired is None else self._expired
        self._task["expiries"] = self._task.get("expiries", 0) + int((expired & ~before).sum())
        self._expired = expired

    def _running(self) -> dict[str, float]:
        steps = len(self._corrections)
        values = (
            self._intervened / steps,
            self._correction_sum / steps,
            float(self._counts["infeasible"]),
            float(self._counts["fallback"]),
            self._finite_margin(),
            self._cost,
            self._cost_substep,
        )
        return dict(zip(keys.RUNNING, values, strict=True))

    def _summary(self) -> dict[str, int | float | bool]:
        steps = len(self._corrections)
        return {
            "length": steps,
            "return": self._return,
            "intervention_rate": self._intervened / steps,
            "correction_mean": self._correction_sum / steps,
            "correction_p95": float(np.percentile(self._corrections, 95)),
            **self._counts,
            "margin_min": self._finite_margin(),
            "violations": self._violations,
            "cost": self._cost,
            "cost_substep": self._cost_substep,
            **self._task,
        }

    def _finite_margin(self) -> float:
        return self._margin_min if math.isfinite(self._margin_min) else 0.0


def read_episodes(path: str | os.PathLike[str]) -> list[dict[str, float]]:
    """Reads back a CSV file of `RecordInterventions`; a half-written last line is left out.

    Args:
        path: The file.

    Returns:
        One dict per episode; empty cells (a task without goals) are left out of it.
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
