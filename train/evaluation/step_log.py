"""Every step of an evaluation in one small file: what the filter did, and where in state space it was."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys

from ..files import write_bytes
from .coordinates import CoordinateReader

MOST_STEPS: Final = 10_000
"""Steps kept of one run under one condition: the first ones. Ten episodes of 1000 steps; 0.1 to 4 MB."""


@dataclass(frozen=True)
class StepLog:
    """T steps of one run (or several) under one condition; floats are float32."""

    episode_seed: NDArray[np.int64]
    """(T,)"""
    step: NDArray[np.int32]
    """(T,): the step's number in its episode, from 0."""
    intervened: NDArray[np.bool_]
    """(T,)"""
    infeasible: NDArray[np.bool_]
    """(T,)"""
    fallback: NDArray[np.bool_]
    """(T,)"""
    violated: NDArray[np.bool_]
    """(T,): the task's own truth saw a cost, at the step's end or at any substep."""
    correction: NDArray[np.float32]
    """(T,): L2, action units."""
    margin: NDArray[np.float32]
    """(T,): the smallest h before the step; NaN without a filter."""
    cost: NDArray[np.float32]
    """(T,): the task's; NaN where it reports none."""
    proposed: NDArray[np.float32]
    """(T, action size): the policy's action."""
    executed: NDArray[np.float32]
    """(T, action size): the action that the env was given."""
    refused: NDArray[np.bool_]
    """(T, constraints): which constraints refused the boxed proposal."""
    coordinates: NDArray[np.float32]
    """(T, coordinates): the state in which the step began."""
    constraint_names: NDArray[np.str_]
    """(constraints,)"""
    coordinate_names: NDArray[np.str_]
    """(coordinates,): with units."""
    left_out: int
    """Steps beyond `MOST_STEPS` that were not kept."""
    filter_time_us: float
    """Mean wall time of one filter call; NaN without a filter."""

    def __len__(self) -> int:
        return len(self.step)


_PER_STEP: Final = tuple(
    field.name
    for field in fields(StepLog)
    if field.name not in ("constraint_names", "coordinate_names", "left_out", "filter_time_us")
)


def is_violation(info: Mapping[str, Any]) -> bool:
    """Whether a step's info has a cost, at the step's end or at any substep."""
    return bool(info.get(keys.COST, 0) > 0 or info.get(keys.COST_SUBSTEP, 0) > 0)


class StepRecorder:
    """Collects an evaluation's steps; keys that no filter wrote count as "did nothing".

    Args:
        env: The whole stack.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        named = env.has_wrapper_attr("constraint_names")
        self._constraints = list(env.get_wrapper_attr("constraint_names")) if named else []
        self._rows: dict[str, list[Any]] = {name: [] for name in _PER_STEP}
        self._left_out = 0

    def begin(self, episode_seed: int) -> None:
        """An episode has been reset."""
        # Only now: some tasks do not know where they are before their first reset.
        self._reader = CoordinateReader(self._env)
        self._episode_seed = episode_seed
        self._step = 0

    def before(self, observation: Any) -> None:
        """Takes down the state in which the next step begins."""
        self._coordinates = self._reader.read(observation)

    def after(self, action: Any, info: dict[str, Any]) -> None:
        """Takes down what the step did.

        Args:
            action: What the policy proposed.
            info: What the step returned.
        """
        step, self._step = self._step, self._step + 1
        if len(self._rows["step"]) >= MOST_STEPS:
            self._left_out += 1
            return
        refused = np.asarray(info.get(keys.CBF_REFUSED, np.zeros(0)), dtype=bool)
        values = {
            "episode_seed": self._episode_seed,
            "step": step,
            "intervened": bool(info.get(keys.CBF_INTERVENED, False)),
            "infeasible": bool(info.get(keys.CBF_INFEASIBLE, False)),
            "fallback": bool(info.get(keys.CBF_FALLBACK, False)),
            "violated": is_violation(info),
            "correction": info.get(keys.CBF_CORRECTION, 0.0),
            "margin": info.get(keys.CBF_MARGIN, np.nan),
            "cost": info.get(keys.COST, np.nan),
            "proposed": np.ravel(info.get(keys.PROPOSED_ACTION, action)),
            "executed": np.ravel(info.get(keys.EXECUTED_ACTION, action)),
            "refused": refused,
            "coordinates": self._coordinates,
        }
        for name, value in values.items():
            self._rows[name].append(value)

    def finish(self) -> StepLog:
        """All steps so far; there must have been one."""
        kinds = {"episode_seed": np.int64, "step": np.int32} | dict.fromkeys(
            ("intervened", "infeasible", "fallback", "violated", "refused"), np.bool_
        )
        columns: dict[str, Any] = {
            name: np.array(values, dtype=kinds.get(name, np.float32)) for name, values in self._rows.items()
        }
        count = columns["refused"].shape[-1]
        timed = self._env.has_wrapper_attr("filter_time_us")
        time_us = self._env.get_wrapper_attr("filter_time_us") if timed else None
        names = self._constraints if len(self._constraints) == count else _numbered(count)
        return StepLog(
            **columns,
            constraint_names=np.array(names, dtype=np.str_),
            coordinate_names=np.array(self._reader.names, dtype=np.str_),
            left_out=self._left_out,
            filter_time_us=np.nan if time_us is None else float(time_us),
        )


def save_steps(path: Path, log: StepLog) -> None:
    """Writes the steps as a compressed npz, an array per field of `StepLog`, atomically."""
    data = io.BytesIO()
    np.savez_compressed(data, **vars(log))
    write_bytes(path, data.getvalue())


def load_steps(path: Path) -> StepLog | None:
    """Reads the steps back; None where an evaluation of another version kept none, or kept something else."""
    if not path.exists():
        return None
    with np.load(path) as arrays:
        if set(arrays.files) != {field.name for field in fields(StepLog)}:
            return None
        values = {name: arrays[name] for name in arrays.files}
    scalars = {"left_out": int(values["left_out"]), "filter_time_us": float(values["filter_time_us"])}
    return StepLog(**{**values, **scalars})


def pool(logs: Sequence[StepLog]) -> StepLog | None:
    """Several runs' steps as one; None without any, or if they are of different tasks or filters."""
    if not logs:
        return None
    first = logs[0]
    for log in logs[1:]:
        for names in ("constraint_names", "coordinate_names"):
            if not np.array_equal(getattr(log, names), getattr(first, names)):
                return None
    return StepLog(
        **{name: np.concatenate([getattr(log, name) for log in logs]) for name in _PER_STEP},
        constraint_names=first.constraint_names,
        coordinate_names=first.coordinate_names,
        left_out=sum(log.left_out for log in logs),
        filter_time_us=float(np.mean([log.filter_time_us for log in logs])),
    )


def _numbered(count: int) -> list[str]:
    return [f"constraint {number}" for number in range(1, count + 1)]
