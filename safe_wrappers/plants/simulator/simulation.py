"""Simulation: runs a task on an env as it would go on from its present state, and leaves the env as it is."""

import copy
import functools
import inspect
import os
import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Literal, TypeVar

import gymnasium as gym
import numpy as np

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of, wrappers_of
from safe_wrappers.plants.simulator.copies import EnvCopier, is_drawn, refuse_finalizers, refuse_recorders

T = TypeVar("T")
Env = gym.Env[Any, Any]
Task = Callable[[Env], T]
Save = Callable[[Any], Any]
"""Takes the unwrapped env; returns its state, which does not change with the env."""
Restore = Callable[[Any, Any], None]
"""Takes the unwrapped env and a saved state, and puts it back."""
Snapshot = tuple[Save, Restore] | Literal["fork"] | None


class Simulation(ABC):
    """An env that can be simulated from its present state.

    Args:
        env: With the wrappers inside the filter.
    """

    remedy: ClassVar[str] = (
        "Say how to restore all of its state, SimulatorPlant(snapshot=(save, restore)), or simulate in child "
        "processes, SimulatorPlant(snapshot='fork'), where the system has them"
    )
    """What to do where the simulation differs from the env."""

    def __init__(self, env: Env) -> None:
        self.env = env

    def start(self) -> None:  # noqa: B027 - most have nothing to do
        """Called in the state that a reset has left."""

    @abstractmethod
    def run(self, task: Task[T]) -> T:
        """What a task returns that steps the env, which is afterwards as it was."""

    def original(self) -> "Simulation":
        """A simulation whose env may be stepped to check it."""
        return self


class CopiedSimulation(Simulation):
    """On a copy of the env."""

    def __init__(self, env: Env) -> None:
        super().__init__(env)
        refuse_finalizers(env)
        self._copier = EnvCopier(env)
        self._copier.copy()

    def start(self) -> None:
        self._copier.start()

    def run(self, task: Task[T]) -> T:
        return task(self._copier.copy())

    def original(self) -> Simulation:
        return CopiedSimulation(EnvCopier(self.env).copy())


class RestoredSimulation(Simulation):
    """On the env itself, whose state is put back by functions; that of its wrappers and its generator by copies."""

    def __init__(self, env: Env, save: Save, restore: Restore) -> None:
        super().__init__(env)
        self._save, self._restore = save, restore

    def run(self, task: Task[T]) -> T:
        raw: Any = self.env.unwrapped
        wrappers = [(vars(layer), _state_of(layer)) for layer in wrappers_of(self.env)]
        state = self._save(raw)
        generator, drawing = copy.deepcopy(raw._np_random), raw.render_mode
        raw.render_mode = None
        try:
            return task(self.env)
        finally:
            self._restore(raw, state)
            raw._np_random, raw.render_mode = generator, drawing
            for attributes, before in wrappers:
                attributes.update(before)


class ForkedSimulation(Simulation):
    """In a child process, which has the env as it is; its cost grows with the memory of this process."""

    remedy = (
        "A child process has all of its memory: what differs lies outside of it (a clock, a file, a server), and the "
        "env's step must not depend on that; or say how to restore it, SimulatorPlant(snapshot=(save, restore))"
    )

    def __init__(self, env: Env) -> None:
        super().__init__(env)
        if not hasattr(os, "fork"):
            raise UnsupportedEnvError(
                "snapshot='fork' needs a system with os.fork, which this one is not; give (save, restore)"
            )

    def run(self, task: Task[T]) -> T:
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


def _answer(task: Task[Any], env: Env, writing: int) -> None:
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


def _state_of(layer: Any) -> dict[str, Any]:
    """Copies of a wrapper's attributes, but for the env inside and what has no state."""
    shared = (gym.Env, gym.Space, gym.envs.registration.EnvSpec)
    try:
        return {
            name: value if isinstance(value, shared) or is_drawn(value) else copy.deepcopy(value)
            for name, value in vars(layer).items()
        }
    except Exception as error:
        raise UnsupportedEnvError(
            f"{type(layer).__name__} inside the filter cannot be restored ({error}); put it outside"
        ) from None


def simulation_of(env: Env, snapshot: Snapshot) -> Simulation:
    """The way to simulate an env: the user's, its own functions, else copies.

    Raises:
        UnsupportedEnvError: It cannot be copied, or there are no child processes.
        ConfigurationError: Another `snapshot`, or a wrapper inside that records.
    """
    refuse_recorders(env)
    if snapshot == "fork":
        return ForkedSimulation(env)
    if snapshot is not None:
        pair = isinstance(snapshot, tuple | list) and len(snapshot) == 2 and all(map(callable, snapshot))
        if not pair:
            raise ConfigurationError(
                "snapshot is two functions, (save, restore) with save(env) and restore(env, state), or 'fork', or"
                f" None for the env's own; got {snapshot!r}"
            )
        return RestoredSimulation(env, *snapshot)
    own = _own_functions(env.unwrapped)
    return CopiedSimulation(env) if own is None else RestoredSimulation(env, *own)


def _own_functions(raw: Any) -> tuple[Save, Restore] | None:
    """`get_state` and `set_state`, or `clone_state` and `restore_state`, of an unwrapped env."""
    for save, restore in (("get_state", "set_state"), ("clone_state", "restore_state")):
        functions = getattr(raw, save, None), getattr(raw, restore, None)
        if not (callable(functions[0]) and callable(functions[1])):
            continue
        # Of an Atari env: its random numbers belong to the state.
        takes = inspect.signature(functions[0]).parameters
        options = {"include_rng": True} if "include_rng" in takes else {}
        return functools.partial(_saved, save, options), functools.partial(_put_back, restore)
    return None


def _saved(method: str, options: dict[str, Any], env: Any) -> Any:
    return copy.deepcopy(getattr(env, method)(**options))


def _put_back(method: str, env: Any, state: Any) -> None:
    getattr(env, method)(copy.deepcopy(state))


def fresh_generator(seed: int) -> np.random.Generator:
    """Random numbers that are not those which the env will draw."""
    return np.random.default_rng([0x5AFE, seed])
