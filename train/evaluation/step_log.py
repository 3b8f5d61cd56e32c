"""Every step of an evaluation in one small file: what the filter did, and where in state space it was."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.errors import Array

from ..files import write_bytes

MOST_STEPS: Final = 20_000
"""Steps kept of one run under one condition: the first ones. Twenty episodes of 1000 steps; 0.2 to 8 MB."""


@dataclass(frozen=True)
class StepLog:
    """T steps of one run (or several) under one condition; shape (T,) where no other is said."""

    episode_seed: NDArray[np.int64]
    step: NDArray[np.int32]  # in its episode, from 0
    intervened: NDArray[np.bool_]  # the filter changed the action
    violated: NDArray[np.bool_]  # the task's own truth saw a cost, at the step's end or at any substep
    correction: NDArray[np.float32]  # L2, action units
    proposed: NDArray[np.float32]  # the policy's action, shape (T, action size)
    refused: NDArray[np.bool_]  # which constraints refused the boxed proposal, shape (T, constraints)
    coordinates: NDArray[np.float32]  # the state in which the step began, shape (T, coordinates)
    constraint_names: NDArray[np.str_]  # shape (constraints,)
    coordinate_names: NDArray[np.str_]  # with units, shape (coordinates,)
    left_out: int  # steps beyond `MOST_STEPS` that were not kept

    def __len__(self) -> int:
        return len(self.step)


_NOT_PER_STEP: Final = ("constraint_names", "coordinate_names", "left_out")
_PER_STEP: Final = tuple(field.name for field in fields(StepLog) if field.name not in _NOT_PER_STEP)


def is_violation(info: Mapping[str, Any]) -> bool:
    """Whether a step's info has a cost, at the step's end or at any substep."""
    return bool(info.get(keys.COST, 0) > 0 or info.get(keys.COST_SUBSTEP, 0) > 0)


def coordinates_of(env: gym.Env[Any, Any]) -> tuple[list[str], Callable[[Any], Array]]:
    """A few named numbers that say where in state space a task is.

    - A task that publishes `agent_position` (seen from above): its place;
    - any other MuJoCo env: every joint's position and speed by name, angles of hinges without limits in [-pi, pi];
    - any other env: its observation, if that is a flat Box.

    Returns:
        Names with units, and a function of the last observation that reads them, shape (names,).
    """
    task: Any = env.unwrapped
    if np.size(getattr(task, "agent_position", ())) >= 2:
        return ["x (m)", "y (m)"], lambda _: np.array(task.agent_position, dtype=float)[:2]
    if hasattr(task, "model") and hasattr(task, "data"):
        model = task.model
        hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
        turning = model.jnt_qposadr[hinge & (model.jnt_limited == 0)]

        def joints(_: Any) -> Array:
            qpos = np.array(task.data.qpos, dtype=float)
            qpos[turning] = (qpos[turning] + math.pi) % math.tau - math.pi
            return np.concatenate([qpos, task.data.qvel])

        return _joint_names(model), joints
    space = env.observation_space
    if isinstance(space, gym.spaces.Box) and len(space.shape) == 1:
        names = [f"observation {at}" for at in range(space.shape[0])]
        return names, lambda observation: np.array(observation, dtype=float)
    return [], lambda _: np.zeros(0)


def _joint_names(model: Any) -> list[str]:
    """Of positions, then of speeds; those of ball and free joints are numbered."""
    units = {int(mujoco.mjtJoint.mjJNT_HINGE): "rad", int(mujoco.mjtJoint.mjJNT_SLIDE): "m"}
    names: list[str] = []
    for what, per, starts, size in (
        ("position", "", model.jnt_qposadr, model.nq),
        ("speed", "/s", model.jnt_dofadr, model.nv),
    ):
        for j, (start, end) in enumerate(zip(starts, [*starts[1:], size], strict=True)):
            name, unit = f"{model.joint(j).name or f'joint {j}'}, {what}", units.get(int(model.jnt_type[j]))
            names += (
                [f"{name} {part}" for part in range(end - start)]
                if unit is None
                else [f"{name} ({unit}{per})"]
            )
    return names


class StepRecorder:
    """Collects an evaluation's steps; keys that no filter wrote count as "did nothing"."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self._rows: dict[str, list[Any]] = {name: [] for name in _PER_STEP}
        self._left_out = 0

    def begin(self, episode_seed: int) -> None:
        """An episode has been reset."""
        # Only now: some tasks do not know where they are before their first reset.
        self._names, self._read = coordinates_of(self._env)
        self._episode_seed, self._step = episode_seed, 0

    def before(self, observation: Any) -> None:
        """Takes down the state in which the next step begins."""
        self._coordinates = self._read(observation)

    def after(self, action: Any, info: dict[str, Any]) -> None:
        """Takes down what the step did."""
        step, self._step = self._step, self._step + 1
        if len(self._rows["step"]) >= MOST_STEPS:
            self._left_out += 1
            return
        values = {
            "episode_seed": self._episode_seed,
            "step": step,
            "intervened": bool(info.get(keys.CBF_INTERVENED, False)),
            "violated": is_violation(info),
            "correction": info.get(keys.CBF_CORRECTION, 0.0),
            "proposed": np.ravel(info.get(keys.PROPOSED_ACTION, action)),
            "refused": np.asarray(info.get(keys.CBF_REFUSED, np.zeros(0)), dtype=bool),
            "coordinates": self._coordinates,
        }
        for name, value in values.items():
            self._rows[name].append(value)

    def finish(self) -> StepLog:
        """All steps so far; there must have been one."""
        flags = ("intervened", "violated", "refused")
        kinds = {"episode_seed": np.int64, "step": np.int32} | dict.fromkeys(flags, np.bool_)
        columns: dict[str, Any] = {
            name: np.array(values, dtype=kinds.get(name, np.float32)) for name, values in self._rows.items()
        }
        named = self._env.has_wrapper_attr("constraint_names")
        names = self._env.get_wrapper_attr("constraint_names") if named else None
        if names is None:
            names = [f"constraint {number + 1}" for number in range(columns["refused"].shape[-1])]
        return StepLog(
            **columns,
            constraint_names=np.array(names, dtype=np.str_),
            coordinate_names=np.array(self._names, dtype=np.str_),
            left_out=self._left_out,
        )


def save_steps(path: Path, log: StepLog) -> None:
    """Writes the steps as a compressed npz, an array per field of `StepLog`, atomically."""
    data = io.BytesIO()
    np.savez_compressed(data, **vars(log))
    write_bytes(path, data.getvalue())


def load_steps(path: Path) -> StepLog | None:
    """Reads the steps back; None where there are none."""
    if not path.exists():
        return None
    with np.load(path) as arrays:
        values: dict[str, Any] = {name: arrays[name] for name in arrays.files}
    return StepLog(**(values | {"left_out": int(values["left_out"])}))


def pool(logs: Sequence[StepLog]) -> StepLog | None:
    """Several runs' steps as one; None without any, or if they are of different tasks or filters."""
    for names in ("constraint_names", "coordinate_names"):
        if len({tuple(getattr(log, names)) for log in logs}) != 1:
            return None
    return StepLog(
        **{name: np.concatenate([getattr(log, name) for log in logs]) for name in _PER_STEP},
        constraint_names=logs[0].constraint_names,
        coordinate_names=logs[0].coordinate_names,
        left_out=sum(log.left_out for log in logs),
    )
