"""The contract of a simulation: from every state it goes on as the env does, bit for bit."""

import copy
import time
import warnings
from typing import Any

import numpy as np

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.env_checks import name_of, reward_numbers
from safe_wrappers.plants.simulator.simulation import Env, Simulation, other_noise

_LONGEST = 10  # steps that are simulated ahead before the env makes them


def check_replay(
    simulation: Simulation, steps: int, limit_s: float, same_noise: bool = True, seed: int = 0
) -> int:
    """Make random steps, each stretch of 1 to 10 in the simulation first and then in the env.

    The env is left reset; its random generator as it was. Where a simulation copies the env, a copy is stepped. With
    `same_noise=False` it is said if other random numbers change nothing.

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
    made, end, changed = 0, time.monotonic() + limit_s, same_noise
    while made < steps and (not made or time.monotonic() < end):
        actions = [space.sample() for _ in range(int(lengths.integers(1, _LONGEST + 1)))]
        ahead = checked.run(lambda other, actions=actions: stretch(other, actions))  # type: ignore[misc]
        if not changed:
            noisy = checked.run(lambda other, actions=actions: _with_other_noise(other, actions))  # type: ignore[misc]
            changed = any(difference(*pair) for pair in zip(ahead, noisy, strict=False))
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
    if not changed:
        warnings.warn(
            f"same_noise=False changes nothing in {name_of(env)}: {made} random steps with other random numbers were "
            "those of the env. Either its steps draw none, or they draw from a generator that is not found, and its "
            "noise is foreseen; NumPy's generators and those of Python's random are found, wherever env and wrappers "
            "keep them",
            stacklevel=2,
        )
    return made


def _with_other_noise(env: Env, actions: list[Any]) -> "list[Answer]":
    with other_noise(env, 0):
        return stretch(env, actions)


Answer = tuple[Any, Any, bool, bool]
"""Observation, reward (a float, or an array where it is a vector), terminated and truncated."""


def stretch(env: Env, actions: list[Any]) -> list[Answer]:
    """What the env answers to actions, until its episode ends."""
    answers: list[Answer] = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        answers.append(
            (copy.deepcopy(observation), reward_numbers(reward), bool(terminated), bool(truncated))
        )
        if terminated or truncated:
            break
    return answers


def difference(simulated: Answer, real: Answer) -> str | None:
    """Where two answers differ, in words; None: nowhere."""
    names = ("observation", "reward", "terminated", "truncated")
    parts = (differing(*each) for each in zip(names, simulated, real, strict=True))
    return next((part for part in parts if part is not None), None)


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
