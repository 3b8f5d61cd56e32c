"""Simulation: runs a task on an env as it would go on from its present state, and leaves the env as it is."""

import copy
import os
import pickle
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.simulator.copies import EnvCopier, refuse_finalizers, refuse_recorders

T = TypeVar("T")
Env = gym.Env[Any, Any]
Task = Callable[[Env], T]


class Simulation(ABC):
    """An env that can be simulated from its present state.

    Args:
        env: With the wrappers inside the filter.
    """

    remedy: ClassVar[str] = (
        "Simulate in child processes, SimulatorPlant(snapshot='fork'), where the system has them"
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


class ForkedSimulation(Simulation):
    """In a child process, which has the env as it is; its cost grows with the memory of this process."""

    remedy = (
        "A child process has all of its memory: what differs lies outside of it (a clock, a file, a server), and the "
        "env's step must not depend on that"
    )

    def __init__(self, env: Env) -> None:
        super().__init__(env)
        if not hasattr(os, "fork"):
            raise UnsupportedEnvError("snapshot='fork' needs a system with os.fork, which this one is not")

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


def simulation_of(env: Env, snapshot: str | None) -> Simulation:
    """The way to simulate an env: by copies, or in child processes.

    Raises:
        UnsupportedEnvError: It cannot be copied, or there are no child processes.
        ConfigurationError: Another `snapshot`, or a wrapper inside that records.
    """
    refuse_recorders(env)
    if snapshot not in (None, "fork"):
        raise ConfigurationError(f"snapshot is 'fork' or None, for copies; got {snapshot!r}")
    return CopiedSimulation(env) if snapshot is None else ForkedSimulation(env)


_LONGEST = 10  # steps that are simulated ahead before the env makes them


def check_replay(simulation: Simulation, steps: int, limit_s: float, seed: int = 0) -> int:
    """Make random steps, each stretch of 1 to 10 in the simulation first and then in the env.

    The env is left reset; its random generator as it was. Where a simulation copies the env, a copy is stepped.

    Returns:
        How many steps were compared: all, or those of the stretches that began in the time.

    Raises:
        UnsupportedEnvError: The first difference of an observation, a reward or an end.
    """
    checked = simulation.original()
    env, raw = checked.env, checked.env.unwrapped
    generator = copy.deepcopy(raw._np_random)
    space = copy.deepcopy(env.action_space)
    space.seed(seed)
    lengths = np.random.default_rng(seed)
    env.reset(seed=seed)
    checked.start()
    made, end = 0, time.monotonic() + limit_s
    while made < steps and (not made or time.monotonic() < end):
        actions = [space.sample() for _ in range(int(lengths.integers(1, _LONGEST + 1)))]
        ahead = checked.run(lambda other, actions=actions: stretch(other, actions))  # type: ignore[misc]
        behind = stretch(env, actions)
        for number, (simulated, real) in enumerate(zip(ahead, behind, strict=False), 1):
            parts = (differing(*each) for each in zip(_PARTS, simulated, real, strict=True))
            found = next((part for part in parts if part is not None), None)
            if found is not None:
                raise UnsupportedEnvError(
                    f"the simulation of {name_of(env)} is not the env: at step {number} after its state was restored "
                    f"(step {made + number} of the check) {found}. {simulation.remedy}"
                )
        made += len(behind)
        if behind[-1][2] or behind[-1][3]:
            env.reset()
            checked.start()
    env.reset(seed=seed)
    raw._np_random = generator
    return made


_PARTS = ("observation", "reward", "terminated", "truncated")
Answer = tuple[Any, float, bool, bool]


def reward_number(env: Env, reward: Any) -> float:
    """The reward, also of an array with one entry; a vector of rewards is refused."""
    if np.size(reward) != 1:
        raise UnsupportedEnvError(
            f"the reward of {name_of(env)} is {reward!r}: put a wrapper inside that makes one number of it"
        )
    return float(np.asarray(reward).item())


def stretch(env: Env, actions: list[Any]) -> list[Answer]:
    """What the env answers to actions, until its episode ends."""
    answers: list[Answer] = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        answer = reward_number(env, reward), bool(terminated), bool(truncated)
        answers.append((copy.deepcopy(observation), *answer))
        if terminated or truncated:
            break
    return answers


def differing(name: str, one: Any, other: Any, tolerance: float = 0.0) -> str | None:
    """Where a simulated part of an answer differs from the env's, in words; None: nowhere.

    Floats may differ by the tolerance, as a share of those above 1.
    """
    if isinstance(one, dict | tuple | list):
        keys = one.keys() if isinstance(one, dict) else range(len(one))
        parts = (differing(f"{name}[{key!r}]", one[key], other[key], tolerance) for key in keys)
        return next((part for part in parts if part is not None), None)
    a, b = np.asarray(one), np.asarray(other)
    if a.dtype != b.dtype:  # a vector env's observations have the dtype of the space
        a = a.astype(b.dtype)
    if a.shape != b.shape:
        return f"its {name} has shape {a.shape} instead of {b.shape}"
    if a.tobytes() == b.tobytes():
        return None
    equal = (a == b) | ((a != a) & (b != b))
    if tolerance and b.dtype.kind == "f":
        equal |= np.isclose(a, b, tolerance, tolerance)
    unequal = np.argwhere(~np.atleast_1d(equal))
    if not len(unequal):
        return None  # zeros of another sign
    at = tuple(unequal[0].tolist())
    one, other = (np.atleast_1d(array)[at].item() for array in (a, b))
    return f"its {name}{list(at) if a.ndim else ''} is {one!r} instead of {other!r}"
