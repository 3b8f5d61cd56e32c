"""Where in state space a step began: a few named numbers of any task, for the picture of the interventions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from safe_wrappers.checks import Array

_FREE_PLACES = ("x (m)", "y (m)", "z (m)", "qw", "qx", "qy", "qz")
_FREE_SPEEDS = ("vx (m/s)", "vy (m/s)", "vz (m/s)", "wx (rad/s)", "wy (rad/s)", "wz (rad/s)")
_OBSTACLES = {"hazard": "hazard_positions", "vase": "vase_positions"}


class CoordinateReader:
    """Reads a task's coordinates before each step of one episode.

    - A task that publishes `agent_position` (seen from above): its place, its speed if the task has a `dt`,
      and where the nearest hazard and vase are; ahead and to the left if it publishes `agent_heading`, else
      their distance.
    - Any other MuJoCo env: every joint's position and speed by name. An angle of a hinge without limits is
      turned into [-pi, pi].
    - Any other env: its observation, if that is a flat Box.

    Args:
        env: The task in its wrappers, reset.

    Attributes:
        names: With units, in the order of what `read` returns; empty where nothing can be read.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._task: Any = env.unwrapped
        self._before: Array | None = None
        self._read: Callable[[Any], Array]
        model = getattr(self._task, "model", None)
        if _published(self._task, "agent_position").size >= 2:
            self._read, self.names = self._scene, self._scene_names()
        elif model is not None and getattr(self._task, "data", None) is not None:
            self._read, self.names = self._joints, _joint_names(model)
            self._turning = _unlimited_hinges(model)
        else:
            space = env.observation_space
            size = space.shape[0] if isinstance(space, Box) and len(space.shape) == 1 else 0
            self._read, self.names = self._observed, tuple(f"observation {at}" for at in range(size))

    def read(self, observation: Any) -> Array:
        """The coordinates now, shape (number of names,); NaN where there is nothing to see.

        Args:
            observation: What the last reset or step returned.
        """
        return self._read(observation)

    def _observed(self, observation: Any) -> Array:
        return np.array(observation, dtype=float) if self.names else np.zeros(0)

    def _joints(self, _: Any) -> Array:
        qpos = np.array(self._task.data.qpos, dtype=float)
        qpos[self._turning] = (qpos[self._turning] + math.pi) % math.tau - math.pi
        return np.concatenate([qpos, self._task.data.qvel])

    def _scene_names(self) -> tuple[str, ...]:
        names = ["x (m)", "y (m)"]
        if hasattr(self._task, "dt"):
            names.append("speed (m/s)")
        for what, attribute in _OBSTACLES.items():
            if hasattr(self._task, attribute):
                sides = ("ahead", "to the left") if hasattr(self._task, "agent_heading") else ("distance",)
                names += [f"nearest {what}, {side} (m)" for side in sides]
        return tuple(names)

    def _scene(self, _: Any) -> Array:
        at = _published(self._task, "agent_position")[:2]
        values = list(at)
        if hasattr(self._task, "dt"):
            before = at if self._before is None else self._before
            values.append(float(np.linalg.norm(at - before)) / float(self._task.dt))
        self._before = at
        for attribute in _OBSTACLES.values():
            if hasattr(self._task, attribute):
                values += self._nearest(at, _published(self._task, attribute))
        return np.array(values)

    def _nearest(self, at: Array, places: Array) -> list[float]:
        heading = getattr(self._task, "agent_heading", None)
        if not places.size:
            return [math.nan] * (1 if heading is None else 2)
        ways = places.reshape(-1, places.shape[-1])[:, :2] - at
        way = ways[np.argmin(np.linalg.norm(ways, axis=1))]
        if heading is None:
            return [float(np.linalg.norm(way))]
        ahead = np.array([math.cos(heading), math.sin(heading)])
        return [float(ahead @ way), float(ahead[0] * way[1] - ahead[1] * way[0])]


def _published(task: Any, name: str) -> Array:
    # A copy: the task may hand out a view of its own state, which the next step overwrites.
    return np.array(getattr(task, name, []), dtype=float)


def _joint_names(model: Any) -> tuple[str, ...]:
    places: list[str] = []
    speeds: list[str] = []
    for at in range(model.njnt):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, at) or f"joint {at}"
        kind = int(model.jnt_type[at])
        if kind == int(mujoco.mjtJoint.mjJNT_HINGE):
            places.append(f"{name}, angle (rad)")
            speeds.append(f"{name}, speed (rad/s)")
        elif kind == int(mujoco.mjtJoint.mjJNT_SLIDE):
            places.append(f"{name}, position (m)")
            speeds.append(f"{name}, speed (m/s)")
        else:
            free = kind == int(mujoco.mjtJoint.mjJNT_FREE)
            places += [f"{name}, {part}" for part in (_FREE_PLACES if free else _FREE_PLACES[3:])]
            speeds += [f"{name}, {part}" for part in (_FREE_SPEEDS if free else _FREE_SPEEDS[3:])]
    return (*places, *speeds)


def _unlimited_hinges(model: Any) -> NDArray[np.int64]:
    turning = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)) & (model.jnt_limited == 0)
    return np.asarray(model.jnt_qposadr[turning], dtype=np.int64)
