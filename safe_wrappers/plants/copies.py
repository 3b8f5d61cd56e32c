"""Copies of an env in its present state: in this process, or as a child process; and whether they do what it does."""

import copy
import inspect
import os
import pickle
import threading
import time
from collections.abc import Callable, Iterator
from types import FunctionType, ModuleType
from typing import Any, TypeVar

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of, wrappers_of
from safe_wrappers.plants.mujoco.model import Constants, every_constant

T = TypeVar("T")
Env = gym.Env[Any, Any]
_DRAWING = ("pygame", "glfw", "OpenGL", "moviepy")
_SHARED = (gym.Space, gym.envs.registration.EnvSpec, ModuleType)
_LOCKS = {type(made()): made for made in (threading.Lock, threading.RLock)}
_RECORDING = ("RecordVideo", "HumanRendering", "RenderCollection")
_FORK = "Simulate in child processes, SimulatorPlant(snapshot='fork'), where the system has them"
_OUTSIDE = (
    "A child process has all of its memory: what differs lies outside of it (a clock, a file, a server), and the "
    "env's step must not depend on that"
)
_LONGEST = 10  # steps that the check simulates before the env makes them


def _envs_of(env: Env) -> Iterator[Env]:
    """The env, what it wraps, and what these hold as attributes, each once."""
    found: set[int] = set()
    left: list[Env] = [env]
    while left:
        one = left.pop()
        if id(one) not in found:
            found.add(id(one))
            yield one
            left += [value for value in vars(one).values() if isinstance(value, gym.Env)]


def _refuse_finalizers(env: Env) -> None:
    """Refuse to copy what closes something when it is deleted: copies would close it for the env, too."""
    seen: set[int] = set()
    left: list[tuple[str, Any]] = [(type(env).__name__, env)]
    while left:
        path, value = left.pop()
        if id(value) in seen or isinstance(value, (*_SHARED, type, FunctionType)) or _is_drawn(value):
            continue
        seen.add(id(value))
        if hasattr(type(value), "__del__") and not isinstance(value, gym.Env):
            raise UnsupportedEnvError(
                f"{name_of(env)} cannot be copied: {path} is a {type(value).__name__}, which closes what it holds "
                f"when a copy of it is deleted. {_FORK}"
            )
        if isinstance(value, dict):
            left += [(f"{path}[{key!r}]", one) for key, one in value.items()]
        elif isinstance(value, list | tuple | set):
            left += [(f"{path}[{i}]", one) for i, one in enumerate(value)]
        else:
            left += [(f"{path}.{name}", one) for name, one in getattr(value, "__dict__", {}).items()]


def _is_drawn(value: Any) -> bool:
    """Whether a value is a window, a renderer or a picture, which no copy needs."""
    package = getattr(type(value), "__module__", "").partition(".")[0]  # SWIG's types have no module
    return package in _DRAWING or type(value).__name__.endswith(("Renderer", "Viewer"))


class EnvCopier:
    """Copies an env again and again; MuJoCo's model is copied when it has changed, its data into one place.

    A copy is valid until the next one is made. EzPickle, whose copies are new envs, has no say. Spaces and specs are
    shared; windows and renderers are left out.

    Args:
        env: With all the wrappers inside the filter.
    """

    def __init__(self, env: Env) -> None:
        self._env = env
        self.start()

    def start(self) -> None:
        """Copy models again: a reset may have changed what is not compared."""
        self._models: dict[int, tuple[Any, Any, Constants]] = {}
        self._data: dict[int, tuple[Any, Any, Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        # What is copied is known by its address, which another process does not have.
        return vars(self) | {"_models": {}, "_data": {}}

    def copy(self) -> Env:
        """The env in its present state.

        Raises:
            UnsupportedEnvError: An attribute cannot be copied; the message has its name.
        """
        envs = list(_envs_of(self._env))
        memo: dict[int, Any] = {id(one): object.__new__(type(one)) for one in envs}
        values = [value for one in envs for value in vars(one).values()]
        memo |= {id(value): value for value in values if isinstance(value, _SHARED)}
        memo |= {id(value): None for value in values if _is_drawn(value)}
        memo |= {id(value): self._model(value) for value in values if isinstance(value, mujoco.MjModel)}
        memo |= {id(value): self._copy_of_data(value) for value in values if isinstance(value, mujoco.MjData)}
        for one in envs:
            attributes: dict[str, Any] = memo[id(one)].__dict__
            for name, value in vars(one).items():
                known = id(value) in memo  # as None, too, which deepcopy would take for "not copied yet"
                attributes[name] = memo[id(value)] if known else _copied(one, name, value, memo)
            if "render_mode" in attributes:
                attributes["render_mode"] = None
        copied: Env = memo[id(self._env)]
        return copied

    def _model(self, model: mujoco.MjModel) -> mujoco.MjModel:
        known = self._models.get(id(model))
        if known is None or known[2].changed():
            self._models[id(model)] = known = model, copy.copy(model), every_constant(model)
            self._data = {}
        return known[1]

    def _copy_of_data(self, data: mujoco.MjData) -> mujoco.MjData:
        if id(data) not in self._data:
            model = self._model(data.model)
            self._data[id(data)] = data, model, mujoco.MjData(model)
        _, model, own = self._data[id(data)]
        mujoco.mj_copyData(own, model, data)
        return own


def _copied(owner: Any, name: str, value: Any, memo: dict[int, Any]) -> Any:
    if isinstance(value, FunctionType):
        held = inspect.getclosurevars(value).nonlocals.values()
        if any(id(getattr(one, "__self__", one)) in memo for one in held):
            raise UnsupportedEnvError(
                f"{name_of(owner)} cannot be copied: the function {type(owner).__name__}.{name} refers to the env "
                "itself, and in a copy would still act on that; make it a method of a wrapper or a subclass"
            )
        return value
    if type(value) in _LOCKS:  # a copy has its own
        return _LOCKS[type(value)]()
    try:
        return copy.deepcopy(value, memo)
    except Exception as error:
        raise UnsupportedEnvError(
            f"{name_of(owner)} cannot be copied: {type(owner).__name__}.{name} is a {type(value).__name__}"
            f" ({error}). {_FORK}"
        ) from None


class Simulation:
    """Runs tasks on an env as it would go on from its present state, and leaves the env as it is.

    Args:
        env: With the wrappers inside the filter.
        snapshot: None runs them on copies; "fork" in child processes, whose cost grows with this one's memory.

    Raises:
        UnsupportedEnvError: The env cannot be copied, or there are no child processes.
        ConfigurationError: Another `snapshot`, or a wrapper inside that draws or writes.
    """

    def __init__(self, env: Env, snapshot: str | None) -> None:
        self.env, self.snapshot = env, snapshot
        for inner in wrappers_of(env):
            if type(inner).__name__ in _RECORDING:
                raise ConfigurationError(
                    f"{type(inner).__name__} inside the filter would also record the steps of the filter's "
                    "simulations; put it outside (filter first, then this wrapper)"
                )
        if snapshot not in (None, "fork"):
            raise ConfigurationError(f"snapshot is 'fork' or None, for copies; got {snapshot!r}")
        self._copier = EnvCopier(env)
        if snapshot is None:
            _refuse_finalizers(env)
            self._copier.copy()
        elif not hasattr(os, "fork"):
            raise UnsupportedEnvError("snapshot='fork' needs a system with os.fork, which this one is not")

    def start(self) -> None:
        """Called in the state that a reset has left."""
        self._copier.start()

    def run(self, task: Callable[[Env], T]) -> T:
        """What a task returns that steps the env, which is afterwards as it was."""
        if self.snapshot is None:
            return task(self._copier.copy())
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            _answer(task, self.env, writing)
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            answer = pipe.read()
        os.waitpid(child, 0)
        if not answer:
            raise UnsupportedEnvError(f"{name_of(self.env)} ended the process that simulated it")
        found, error = pickle.loads(answer)
        if error is not None:
            raise error
        value: T = found
        return value

    def check(self, steps: int, limit_s: float) -> int:
        """Make random steps in a simulation, each stretch of 1 to 10 once more in a simulation of that.

        Returns:
            How many steps were compared: all, or those of the stretches that began in the time.

        Raises:
            UnsupportedEnvError: The first difference of an observation, a reward or an end.
        """
        return self.run(lambda env: Simulation(env, self.snapshot)._compared(steps, limit_s))

    def _compared(self, steps: int, limit_s: float) -> int:
        """See `check`; the env is stepped."""
        env, space, lengths = self.env, copy.deepcopy(self.env.action_space), np.random.default_rng(0)
        space.seed(0)
        made, end, over = 0, time.monotonic() + limit_s, True
        while made < steps and (not made or time.monotonic() < end):
            if over:
                env.reset(seed=None if made else 0)
                self.start()
            actions = [space.sample() for _ in range(int(lengths.integers(1, _LONGEST + 1)))]
            ahead = self.run(lambda other, actions=actions: _answers(other, actions))  # type: ignore[misc]
            behind = _answers(env, actions)
            for number, pair in enumerate(zip(ahead, behind, strict=False), 1):
                found = filter(
                    None, map(differing, ("observation", "reward", "terminated", "truncated"), *pair)
                )
                if difference := next(found, None):
                    raise UnsupportedEnvError(
                        f"the simulation of {name_of(env)} is not the env: at step {number} after its state was "
                        f"restored (step {made + number} of the check) {difference}. "
                        f"{_OUTSIDE if self.snapshot else _FORK}"
                    )
            made, over = made + len(behind), behind[-1][2] or behind[-1][3]
        return made


def _answer(task: Callable[[Env], Any], env: Env, writing: int) -> None:
    """In the child: write what the task returns or raises, and end without any clean-up of the parent's."""
    try:
        raw: Any = env.unwrapped
        raw.render_mode = None
        try:
            answer = pickle.dumps((task(env), None))
        except Exception as error:
            answer = pickle.dumps((None, error))
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(answer)
    finally:
        os._exit(0)


def reward_number(env: Env, reward: Any) -> float:
    """The reward, also of an array with one entry; a vector of rewards is refused."""
    if np.size(reward) != 1:
        raise UnsupportedEnvError(
            f"the reward of {name_of(env)} is {reward!r}: put a wrapper inside that makes one number of it"
        )
    return float(np.asarray(reward).item())


def _answers(env: Env, actions: list[Any]) -> list[tuple[Any, float, bool, bool]]:
    """What the env answers to actions, until its episode ends."""
    answers: list[tuple[Any, float, bool, bool]] = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        ends = bool(terminated), bool(truncated)
        answers.append((copy.deepcopy(observation), reward_number(env, reward), *ends))
        if any(ends):
            break
    return answers


def differing(name: str, one: Any, other: Any, tolerance: float = 0.0) -> str | None:
    """Where a simulated part of an answer differs from the env's, floats by more than a share; None: nowhere."""
    if isinstance(one, dict | tuple | list):
        keys = one.keys() if isinstance(one, dict) else range(len(one))
        parts = (differing(f"{name}[{key!r}]", one[key], other[key], tolerance) for key in keys)
        return next(filter(None, parts), None)
    a, b = np.asarray(one), np.asarray(other)
    a = a.astype(b.dtype)  # a vector env's observations have the dtype of the space
    if a.shape != b.shape:
        return f"its {name} has shape {a.shape} instead of {b.shape}"
    close = np.isclose(a, b, tolerance, tolerance, equal_nan=True) if b.dtype.kind in "fc" else a == b
    for at in map(tuple, np.argwhere(~np.atleast_1d(close))[:1].tolist()):
        one, other = (np.atleast_1d(array)[at].item() for array in (a, b))
        return f"its {name}{list(at) if a.ndim else ''} is {one!r} instead of {other!r}"
    return None
