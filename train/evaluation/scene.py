"""Top-down scenes: what a trajectory picture needs of an episode, for tasks that publish it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array

from ..files import write_bytes
from .step_log import is_violation

_STATIC = ("hazard_positions", "hazard_radius", "goal_radius", "vase_positions")


@dataclass(frozen=True)
class Scene:
    """One episode seen from above; lengths in metres."""

    agent: Array
    """(steps + 1, 2): where the robot was."""
    intervened: NDArray[np.bool_]
    """(steps,): where the filter changed the action; step t starts at `agent[t]`."""
    violated: NDArray[np.bool_]
    """(steps,): where the task's own truth saw a violation."""
    goals: Array
    """(n, 2): each place that the goal was at."""
    hazards: Array
    """(n, 2)."""
    hazard_radius: float
    goal_radius: float
    vases: Array
    """(n, 2): at the episode's start."""


class SceneRecorder:
    """Collects an episode's scene; `finish` gives None for a task that does not publish `agent_position`."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._task = env.unwrapped
        self._static = {name: np.array(getattr(self._task, name, []), dtype=float) for name in _STATIC}
        self._agent = [self._place("agent_position")]
        self._goals = [self._place("goal_position")]
        self._intervened: list[bool] = []
        self._violated: list[bool] = []

    def step(self, info: dict[str, Any]) -> None:
        """Takes down the state after a step."""
        self._agent.append(self._place("agent_position"))
        goal = self._place("goal_position")
        if not np.array_equal(goal, self._goals[-1]):
            self._goals.append(goal)
        self._intervened.append(bool(info.get(keys.CBF_INTERVENED, False)))
        self._violated.append(is_violation(info))

    def finish(self) -> Scene | None:
        """The episode's scene."""
        if not self._agent[0].size:
            return None
        return Scene(
            agent=np.array(self._agent),
            intervened=np.array(self._intervened, dtype=bool),
            violated=np.array(self._violated, dtype=bool),
            goals=np.array([goal for goal in self._goals if goal.size]).reshape(-1, 2),
            hazards=_plane(self._static["hazard_positions"]),
            hazard_radius=self._radius("hazard_radius"),
            goal_radius=self._radius("goal_radius"),
            vases=_plane(self._static["vase_positions"]),
        )

    def _radius(self, name: str) -> float:
        return float(self._static[name].max()) if self._static[name].size else 0.0

    def _place(self, name: str) -> Array:
        # The task may hand out a view of its own state, which the next step overwrites.
        return np.array(getattr(self._task, name, []), dtype=float).reshape(-1)[:2]


def save_scenes(path: Path, scenes: dict[int, Scene]) -> None:
    """Writes scenes by episode seed, atomically."""
    arrays = {
        f"{seed}/{name}": value for seed, scene in scenes.items() for name, value in vars(scene).items()
    }
    data = io.BytesIO()
    np.savez_compressed(data, **arrays)
    write_bytes(path, data.getvalue())


def load_scenes(path: Path) -> dict[int, Scene]:
    """Reads scenes by episode seed; empty when there are none."""
    if not path.exists():
        return {}
    fields: dict[int, dict[str, Any]] = {}
    with np.load(path) as arrays:
        for key in arrays.files:
            seed, _, name = key.partition("/")
            fields.setdefault(int(seed), {})[name] = arrays[key]
    for values in fields.values():
        values |= {name: float(values[name]) for name in ("hazard_radius", "goal_radius")}
    return {seed: Scene(**values) for seed, values in fields.items()}


def _plane(points: Array) -> Array:
    return points.reshape(len(points), -1)[:, :2] if points.size else np.zeros((0, 2))
