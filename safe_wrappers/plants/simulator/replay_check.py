"""The contract of a simulation: from every state it goes on as the env does, bit for bit."""

import copy
from typing import Any

import numpy as np

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.simulator.simulation import Env, Simulation

_LONGEST = 10  # steps that are simulated ahead before the env makes them


def check_replay(simulation: Simulation, steps: int, seed: int = 0) -> None:
    """Make random steps, each stretch of 1 to 10 in the simulation first and then in the env.

    The env is left reset; its random generator as it was. Where a simulation copies the env, a copy is stepped.

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
    made = 0
    while made < steps:
        actions = [space.sample() for _ in range(int(lengths.integers(1, _LONGEST + 1)))]
        ahead = checked.run(lambda other, actions=actions: stretch(other, actions))  # type: ignore[misc]
        behind = stretch(env, actions)
        for number, (simulated, real) in enumerate(zip(ahead, behind, strict=False), 1):
            found = difference(simulated, real)
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


Answer = tuple[Any, float, bool, bool]
"""Observation, reward, terminated and truncated."""


def stretch(env: Env, actions: list[Any]) -> list[Answer]:
    """What the env answers to actions, until its episode ends."""
    answers: list[Answer] = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        answers.append((copy.deepcopy(observation), float(reward), bool(terminated), bool(truncated)))
        if terminated or truncated:
            break
    return answers


def difference(simulated: Answer, real: Answer) -> str | None:
    """Where two answers differ, in words; None: nowhere."""
    for name, one, other in zip(("reward", "terminated", "truncated"), simulated[1:], real[1:], strict=True):
        if one != other and not (one != one and other != other):
            return f"its {name} is {one!r} instead of {other!r}"
    return _differing("observation", simulated[0], real[0])


def _differing(name: str, one: Any, other: Any) -> str | None:
    if isinstance(one, dict | tuple | list):
        keys = one.keys() if isinstance(one, dict) else range(len(one))
        parts = (_differing(f"{name}[{key!r}]", one[key], other[key]) for key in keys)
        return next((part for part in parts if part is not None), None)
    a, b = np.asarray(one), np.asarray(other)
    if a.shape != b.shape:
        return f"its {name} has shape {a.shape} instead of {b.shape}"
    if a.tobytes() == b.tobytes():
        return None
    unequal = np.argwhere(~np.atleast_1d((a == b) | ((a != a) & (b != b))))
    if not len(unequal):
        return None  # zeros of another sign
    at = tuple(unequal[0].tolist())
    one, other = (np.atleast_1d(array)[at].item() for array in (a, b))
    return f"its {name}{list(at)} is {one!r} instead of {other!r}"
