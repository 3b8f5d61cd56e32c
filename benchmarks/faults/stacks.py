"""The rows of the fault matrix: wrappers, fault injectors and constraints, over an env that sees what reaches it."""

import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.faults import constraint_examples, injector_examples, wrapper_examples
from benchmarks.faults.episodes import actions, plain, trace
from safe_wrappers.plants.env_checks import wrappers_of

LONG, BEFORE = 24, 6
"""Steps of an episode, and those before the fault."""
VECTOR = "VectorCBFActionFilter"
PASSING = (*wrapper_examples.ONLY_LOOKING, *injector_examples.EXAMPLES, "LeaseExpiry", "TeleopChannel")
"""Wrappers that judge no action: it is for a filter inside to keep the action space."""


class BrokenEnvError(RuntimeError):
    """What an env raises that breaks."""


_GATES: dict[int, tuple[threading.Event, threading.Event]] = {}
"""By the id of a `Bottom`, whose copies have none: events that a step is inside, and that it may go on."""


class Bottom(gym.Wrapper[Any, Any, Any, Any]):
    """The env itself: keeps what reached it, and breaks or blocks when it is told to.

    Attributes:
        given: Every action that reached the env.
        breaks: "step" or "reset", which then raises.
        leaves: What the next step leaves in the state, and returns as observation.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.given: list[Any] = []
        self.breaks = ""
        self.leaves: float | None = None

    def block(self) -> tuple[threading.Event, threading.Event]:
        """The next step alone waits: events that say that it is inside, and that it may go on."""
        _GATES[id(self)] = threading.Event(), threading.Event()
        return _GATES[id(self)]

    def step(self, action: Any) -> Any:
        gate = _GATES.pop(id(self), None)
        if gate is not None:
            gate[0].set()
            gate[1].wait(20.0)
        if self.breaks == "step":
            raise BrokenEnvError("the env broke in step")
        self.given.append(np.array(action))
        if self.leaves is None:
            return self.env.step(action)
        value, self.leaves = self.leaves, None
        observation, *rest = self.env.step(action)
        raw: Any = self.unwrapped
        if hasattr(raw, "data"):
            raw.data.qpos[0] = raw.data.qvel[0] = value
        else:
            raw.state = np.full_like(np.asarray(raw.state, dtype=np.float64), value)
        return _filled(observation, value), *rest

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if self.breaks == "reset":
            raise BrokenEnvError("the env broke in reset")
        return self.env.reset(seed=seed, options=options)


def _filled(observation: Any, value: float) -> Any:
    if isinstance(observation, dict):
        return {key: _filled(one, value) for key, one in observation.items()}
    return np.full_like(observation, value)


@dataclass(frozen=True)
class Row:
    """One wrapper or constraint.

    Attributes:
        name: As it is exported.
        case: Of a wrapper's or an injector's examples; "" of a constraint.
        build: Makes it; takes what is put around the task, and more arguments of the wrapper.
        passes: It judges no action, and passes finite ones as they are.
    """

    name: str
    case: str
    build: Callable[..., Any] = field(repr=False)
    passes: bool = False

    @property
    def kind(self) -> str:
        """Wrapper or constraint."""
        return "constraint" if self.name in constraint_examples.EXAMPLES else "wrapper"

    def open(self, **more: Any) -> "Session":
        """A new one, before its first episode."""
        bottoms: list[Bottom] = []

        def around(env: gym.Env[Any, Any]) -> Bottom:
            bottoms.append(Bottom(env))
            return bottoms[-1]

        with warnings.catch_warnings(action="ignore"):
            return Session(self.build(around, **more), bottoms)

    def bare(self) -> "Session":
        """The task alone."""
        bottom = self.open().bottoms[0]
        return Session(bottom, [bottom])


@dataclass
class Answer:
    """Of one step: what it returned, or the error; what was warned of; what reached the env."""

    returned: Any = None
    error: Exception | None = None
    warned: list[str] = field(default_factory=list)
    reached: list[Any] = field(default_factory=list)

    @property
    def info(self) -> dict[str, Any]:
        """The step's info."""
        return {} if self.returned is None else self.returned[4]


class Session:
    """A wrapped env, and the recorders at its bottom."""

    def __init__(self, env: Any, bottoms: list[Bottom]) -> None:
        self.env, self.bottoms = env, bottoms
        self.actions = actions(env, LONG)

    def begin(self, steps: int = BEFORE) -> "Session":
        """Reset, and make the first steps of the episode."""
        with warnings.catch_warnings(action="ignore"):
            self.env.reset(seed=0)
            for action in self.actions[:steps]:
                self.env.step(action)
        return self

    def step(self, action: Any) -> Answer:
        """One step, whatever comes of it."""
        before = [len(bottom.given) for bottom in self.bottoms]
        answer = Answer()
        with warnings.catch_warnings(record=True, action="always") as warned:
            try:
                answer.returned = self.env.step(action)
            except Exception as error:
                answer.error = error
        answer.warned = [str(one.message) for one in warned]
        for bottom, count in zip(self.bottoms, before, strict=True):
            answer.reached += bottom.given[count:]
        return answer

    def ended(self, answer: Answer) -> bool:
        """Whether the episode is over."""
        return answer.returned is None or bool(np.any(answer.returned[2]) or np.any(answer.returned[3]))

    def episode(self) -> Any:
        """Everything an agent sees of an episode from the first seed."""
        with warnings.catch_warnings(action="ignore"):
            return trace(self.env, steps=LONG)

    def raw(self) -> Any:
        """The unwrapped env, of a vector env the first."""
        return self.bottoms[0].unwrapped

    def layers(self) -> list[Any]:
        """The wrappers, outermost first; of a vector env its filters."""
        filters = getattr(self.env, "filters", None)
        return list(wrappers_of(self.env)) if filters is None else list(filters)

    def engines(self) -> list[Any]:
        """The `SafetyFilter` of every filter, and of what only looks as one."""
        filters = [one for one in self.layers() if isinstance(one, sw.CBFActionFilter)]
        filters += [one._observer for one in self.layers() if isinstance(one, sw.FilterObservation)]
        return list({id(one): one.filter for one in filters}.values())

    def bound(self) -> list[Any]:
        """The constraints, and those that a budget reads."""
        found = [constraint for engine in self.engines() for constraint in engine.bound]
        for layer in self.layers():
            budgets = getattr(layer, "_budget", None), getattr(getattr(layer, "_watch", None), "budget", None)
            found += [one._bound for one in budgets if one is not None and one._bound is not None]
        return found


def same(a: Answer, b: Answer) -> bool:
    """Whether two steps returned the same, bit for bit."""
    return a.error is None and b.error is None and plain(a.returned) == plain(b.returned)


def _vector(around: Callable[..., Any], **more: Any) -> Any:
    envs = gym.vector.SyncVectorEnv([lambda: around(gym.make(wrapper_examples.TASK)) for _ in range(2)])
    return sw.VectorCBFActionFilter(envs, [wrapper_examples.clearance()], **more)


def _constraint(name: str) -> Callable[..., Any]:
    return lambda around, **more: constraint_examples.EXAMPLES[name].make(around, **more)


def _wrapper(name: str, case: str) -> Callable[..., Any]:
    # The check of a simulation takes longer than everything else of a cell.
    own = {"plant": lambda: sw.SimulatorPlant(check_steps=20)} if name == "ActionShield" else {}
    return lambda around, **more: wrapper_examples.build(
        name, case, around, **{key: make() for key, make in own.items()}, **more
    )


def _injector(name: str, case: str) -> Callable[..., Any]:
    return lambda around, **more: injector_examples.build(name, case, around, **more)


def rows(only: str = "") -> Iterator[Row]:
    """All rows, wrappers first; of one name alone."""
    for name, case in wrapper_examples.CASES:
        if only in ("", name):
            yield Row(name, case, _wrapper(name, case), name in PASSING)
    for name, case in injector_examples.CASES:
        if only in ("", name):
            yield Row(name, case, _injector(name, case), name in PASSING)
    if only in ("", VECTOR):
        yield Row(VECTOR, "two envs", _vector)
    for name in constraint_examples.EXAMPLES:
        if only in ("", name):
            yield Row(name, "", _constraint(name))
