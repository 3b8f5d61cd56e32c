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
    """(n, 2): at the episode's start, as the vases."""
    vases: Array
    """(n, 2)."""
    hazard_radius: float
    goal_radius: float


class SceneRecorder:
    """Collects an episode's scene; `finish` gives None for a task that does not publish `agent_position`."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._task = env.unwrapped
        self._hazards, self._vases = self._places("hazard_positions"), self._places("vase_positions")
        self._agent = [self._places("agent_position")]
        self._goals = [self._places("goal_position")]
        self._flags: list[tuple[bool, bool]] = []

    def step(self, info: dict[str, Any]) -> None:
        """Takes down the state after a step."""
        self._agent.append(self._places("agent_position"))
        goal = self._places("goal_position")
        if not np.array_equal(goal, self._goals[-1]):
            self._goals.append(goal)
        self._flags.append((bool(info.get(keys.CBF_INTERVENED, False)), is_violation(info)))

    def finish(self) -> Scene | None:
        """The episode's scene."""
        if not self._agent[0].size:
            return None
        radii = [float(np.max(getattr(self._task, f"{what}_radius", 0.0))) for what in ("hazard", "goal")]
        intervened, violated = np.array(self._flags, dtype=bool).reshape(-1, 2).T
        agent, goals = np.concatenate(self._agent), np.concatenate(self._goals)
        return Scene(agent, intervened, violated, goals, self._hazards, self._vases, *radii)

    def _places(self, name: str) -> Array:
        """Shape (n, 2); a copy, since the task may hand out a view of its own state."""
        places = np.array(getattr(self._task, name, []), dtype=float)
        return np.atleast_2d(places)[:, :2] if places.size else np.zeros((0, 2))


def save_scenes(path: Path, scenes: dict[int, Scene]) -> None:
    """Writes scenes by episode seed, atomically."""
    data = io.BytesIO()
    np.savez_compressed(
        data,
        **{f"{seed}/{name}": value for seed, scene in scenes.items() for name, value in vars(scene).items()},
    )
    write_bytes(path, data.getvalue())


def load_scene(path: Path, episode_seed: int) -> Scene | None:
    """An episode's scene; None where there is none."""
    if not path.exists():
        return None
    with np.load(path) as arrays:
        prefix = f"{episode_seed}/"
        values: dict[str, Any] = {
            key.removeprefix(prefix): arrays[key] for key in arrays.files if key.startswith(prefix)
        }
    if not values:
        return None
    radii = {name: float(values[name]) for name in ("hazard_radius", "goal_radius")}
    return Scene(**(values | radii))
