"""An env linearised at states that were recorded: its control step, its observation, and what its task counts."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.diagnosis.recording import Env, Recording
from safe_wrappers.diagnosis.symptom import NotMeasuredError, require_physics
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.plants.mujoco.model import BALL, FREE
from safe_wrappers.plants.snapshot import STATE
from safe_wrappers.wrappers.occlusion_penalty import OcclusionPenalty

NUDGE = 1e-4
"""Of differences, in the spread that a state had in the run."""
MOVES = 1e-3
"""m, rad, m/s or rad/s: a state with a smaller spread stands still, and nothing has to be known of it."""
SWAYS = 0.01
"""Of the reward's spread in the run, and of a cost of 1: what is less does not count."""


class LinearModel(NamedTuple):
    """Slopes at one state; states in units of their spread, numbers in units of their own."""

    a: Array  # of the control step, shape (n, n)
    c: Array  # of the observation, shape (p, n); slopes that are no more than rounding are 0


def observation_reader(env: Env) -> Callable[[], Array]:
    """Reads the observation of the state in which the unwrapped env's data are, flat, through all wrappers.

    Raises:
        NotMeasuredError: The env has no such function, or a wrapper shows what depends on more than the state.
    """
    read = _own_reader(env.unwrapped)
    functions: list[Callable[[Any], Any]] = []
    for wrapper in reversed(list(wrappers_of(env))):
        own = not type(wrapper).__module__.startswith("gymnasium.")
        if isinstance(wrapper, gym.ObservationWrapper):
            # Gymnasium's others scale, delay, or count time: what can be told from their observations is the same.
            if own or isinstance(wrapper, gym.wrappers.TransformObservation):
                functions.append(wrapper.observation)
        elif wrapper.observation_space != wrapper.env.observation_space and not isinstance(
            wrapper, OcclusionPenalty
        ):
            raise NotMeasuredError(
                f"{type(wrapper).__name__} shows another observation than the env, which cannot be asked for in "
                "another state"
            )

    def seen() -> Array:
        return _flat(functools.reduce(lambda given, function: function(given), functions, read()))

    try:
        steady = np.array_equal(seen(), seen(), equal_nan=True)
    except NotMeasuredError:
        raise
    except Exception as error:
        raise NotMeasuredError(
            f"the env's observation raised {type(error).__name__} when it was asked for between two steps: {error}"
        ) from error
    if not steady:
        raise NotMeasuredError("the env gives two observations of one state: it adds noise")
    return seen


def _own_reader(raw: Any) -> Callable[[], Any]:
    for name in ("observe", "_get_obs"):
        function: Callable[[], Any] | None = getattr(raw, name, None)
        if function is not None and not inspect.signature(function).parameters:
            return function
    for name in ("point_env", "ant_env"):  # gymnasium-robotics' mazes
        if hasattr(raw, name):
            return functools.partial(_of_maze, raw, getattr(raw, name))
    raise NotMeasuredError(
        "the env has neither observe() nor _get_obs() without arguments, so that its observation cannot be read in "
        "another state"
    )


def _of_maze(maze: Any, inside: Any) -> Any:
    given = inside._get_obs()
    return maze._get_obs(given[0] if isinstance(given, tuple) else given)


def _flat(observation: Any) -> Array:
    parts = list(observation.values()) if isinstance(observation, dict) else [observation]
    if not all(isinstance(part, np.ndarray) and np.issubdtype(part.dtype, np.floating) for part in parts):
        raise NotMeasuredError(
            "the observation is not made of numbers that change smoothly, as images are not"
        )
    return np.concatenate([np.ravel(part) for part in parts]).astype(np.float64)


class Linearised:
    """Slopes of an env at the states of a recording.

    Args:
        env: With a MuJoCo model; its data are moved while this works, and put back.
        recording: Of the same env.
        places: Of the unwrapped env's data: places that the task counts, shape (r,), m.

    Raises:
        NotMeasuredError: No model, no observation of another state, or nothing that moves.

    Attributes:
        names: Of the n states that moved: a joint's position or speed.
        spread: Their standard deviations in the run, shape (n,), m, rad, m/s or rad/s.
    """

    def __init__(self, env: Env, recording: Recording, places: Callable[[mujoco.MjData], Array]) -> None:
        self._raw: Any = env.unwrapped
        self._model, self._data = require_physics(env, "that could be linearised")
        self._own = mujoco.MjData(self._model)
        self._recording, self._places = recording, places
        self._kept = np.zeros(mujoco.mj_stateSize(self._model, STATE))
        mujoco.mj_getState(self._model, self._data, self._kept, STATE)
        self._read = observation_reader(env)
        kind: Any = gym.spaces.flatten_space(env.observation_space).dtype
        self._resolution = float(np.finfo(kind).eps) if kind == np.float32 else 0.0
        self._substeps = max(round(recording.control_dt / self._model.opt.timestep), 1)
        every = np.concatenate([self._tangents(), recording.qvel], axis=1)
        spread = every[~recording.diverged].std(axis=0)
        self._moving = np.flatnonzero(spread > MOVES)
        if not self._moving.size:
            raise NotMeasuredError("nothing has moved")
        self.spread = spread[self._moving]
        names = [_dof_name(self._model, i) for i in range(self._model.nv)]
        self.names = [[*names, *(f"speed of {name}" for name in names)][i] for i in self._moving]

    def _tangents(self) -> Array:
        """Positions as ways from the first one, shape (k, nv)."""
        ways = np.zeros((len(self._recording.qpos), self._model.nv))
        for way, qpos in zip(ways, self._recording.qpos, strict=True):
            mujoco.mj_differentiatePos(self._model, way, 1.0, self._recording.qpos[0], qpos)
        return ways

    def at(self, step: int, more: Callable[[], Array]) -> LinearModel:
        """Slopes at the state that a control step left.

        Args:
            step: Its index.
            more: What the observation says besides, of the unwrapped env's data, shape (q,).
        """
        every = np.eye(len(self.names))
        a = self._slopes(step, every, self._after)
        c = self._slopes(step, every, lambda _: np.concatenate([self._read(), more()]), self._resolution)
        return LinearModel(a[self._moving] / self.spread[:, None], c)

    def counted(self, step: int, directions: Array) -> Array:
        """How much directions of the state, columns in spreads, sway what the task counts, shape (r, k).

        In units of what matters: a millimetre of a place, a hundredth of the reward's spread, or of a cost of 1.
        """
        slopes = self._slopes(step, directions, self._counts)
        rewards = self._recording.rewards
        reward = max(SWAYS * float(rewards.std()), 1e-6)
        return np.asarray(slopes / np.array([*[MOVES] * (len(slopes) - 2), reward, SWAYS])[:, None])

    def _slopes(
        self, step: int, directions: Array, function: Callable[[int], Array], resolution: float = 0.0
    ) -> Array:
        """Central differences along columns, shape (m, k); 0 where they are no more than rounding."""
        try:
            upper, lower = (
                np.array([self._nudged(step, by * direction, function) for direction in directions.T])
                for by in (NUDGE, -NUDGE)
            )
        except NotMeasuredError:
            raise
        except Exception as error:
            raise NotMeasuredError(
                f"the env raised {type(error).__name__} in a state next to one of the run: {error}"
            ) from error
        finally:
            mujoco.mj_setState(self._model, self._data, self._kept, STATE)
            mujoco.mj_forward(self._model, self._data)
        size = np.maximum(np.abs(upper), np.abs(lower)).max(axis=0)
        rounding = (100.0 * np.finfo(np.float64).eps + 2.0 * resolution) * size / NUDGE + 1e-9
        slopes = (upper - lower) / (2.0 * NUDGE)
        return np.asarray(np.where(np.abs(slopes) > rounding, slopes, 0.0).T)

    def _nudged(self, step: int, by: Array, function: Callable[[int], Array]) -> Array:
        """What a function says of the env's data with the state nudged by so many spreads."""
        model, data, recording = self._model, self._data, self._recording
        mujoco.mj_setState(model, data, self._kept, STATE)
        data.qpos[:], data.qvel[:] = recording.qpos[step], recording.qvel[step]
        data.ctrl[:] = recording.controls[step]
        change = np.zeros(2 * model.nv)
        change[self._moving] = by * self.spread
        mujoco.mj_integratePos(model, data.qpos, change[: model.nv], 1.0)
        data.qvel[:] += change[model.nv :]
        mujoco.mj_forward(model, data)
        return function(step)

    def _after(self, step: int) -> Array:
        """The state after a control step with the controls held, as a way from the recorded one, shape (2 nv,)."""
        model, own, recording = self._model, self._own, self._recording
        state = np.zeros_like(self._kept)
        mujoco.mj_getState(model, self._data, state, STATE)
        mujoco.mj_setState(model, own, state, STATE)
        mujoco.mj_step(model, own, self._substeps)
        way = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, way, 1.0, recording.qpos[step], own.qpos)
        return np.concatenate([way, own.qvel])

    def _counts(self, step: int) -> Array:
        """What the task counts: places now, and the reward and the cost of a step from here."""
        places = np.array(self._places(self._data), dtype=np.float64)
        space = self._raw.action_space
        action = self._recording.executed[step].astype(space.dtype)
        _, reward, _, _, info = self._raw.step(action)
        return np.concatenate([places, [float(reward), float(np.nan_to_num(info.get("cost", 0.0)))]])


def _dof_name(model: mujoco.MjModel, dof: int) -> str:
    """Of its joint, and which of the joint's ways."""
    joint = int(model.dof_jntid[dof])
    name = model.joint(joint).name or f"joint {joint}"
    kind, which = int(model.jnt_type[joint]), dof - int(model.jnt_dofadr[joint])
    if kind == FREE:
        return f"{name} {('x', 'y', 'z', 'turn x', 'turn y', 'turn z')[which]}"
    return f"{name} turn {'xyz'[which]}" if kind == BALL else name
