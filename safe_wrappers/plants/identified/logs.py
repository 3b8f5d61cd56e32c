"""Logged episodes: what a model is fitted to, and its errors are measured on."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, float_array, whole_number
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.rollouts import Measure, View


class Episode(NamedTuple):
    """One logged episode of T steps: observations, shape (T + 1, n), and actions, shape (T, m)."""

    observations: Array
    actions: Array


def log_steps(
    env: gym.Env[Any, Any],
    policy: Callable[[Any], Any] | None = None,
    episodes: int = 100,
    seed: int = 0,
    max_steps: int = 1000,
) -> list[Episode]:
    """Drive an env and log it.

    Logged is the executed action, where a filter inside reports one, else the policy's.

    Args:
        env: With observations of shape (n,).
        policy: Takes an observation, returns an action; None draws actions from the action space.
        episodes: How many.
        seed: Of the first reset, and of drawn actions. The other resets go on with the env's generator.
        max_steps: An episode that has not ended by then is cut off.

    Raises:
        ConfigurationError: Observations of another kind, or counts that are no whole numbers.
    """
    episodes = whole_number("episodes", episodes, 1, "episodes")
    max_steps = whole_number("max_steps", max_steps, 1, "steps")
    space = copy.deepcopy(env.action_space)  # the env's own generator stays as it was
    space.seed(seed)
    found: list[tuple[Any, Any]] = []
    for index in range(episodes):
        observation, info = env.reset(seed=seed if index == 0 else None)
        observations, actions = [copy.copy(observation)], []
        for _ in range(max_steps):
            action = space.sample() if policy is None else policy(observation)
            observation, _, terminated, truncated, info = env.step(action)
            # A copy: some envs return the same array again, changed.
            observations.append(copy.copy(observation))
            actions.append(np.atleast_1d(info.get(keys.EXECUTED_ACTION, action)))
            if terminated or truncated:
                break
        found.append((observations, actions))
    return checked_episodes(found)


def checked_episodes(given: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[Episode]:
    """The episodes as arrays of float64 of one width.

    Raises:
        ConfigurationError: Other shapes, or numbers that are not finite; the message says in which episode.
    """
    if isinstance(given, str | dict | np.ndarray) or not isinstance(given, Sequence) or not given:
        raise ConfigurationError(
            f"episodes is a list of (observations, actions), as log_steps returns it; got {given!r}"
        )
    found = [_checked(index, one) for index, one in enumerate(given)]
    for index, one in enumerate(found):
        for name, have, first in zip(Episode._fields, one, found[0], strict=True):
            if have.shape[1] != first.shape[1]:
                raise ConfigurationError(
                    f"episode {index} has {name} of {have.shape[1]} numbers, episode 0 of {first.shape[1]}"
                )
    return found


def _checked(index: int, given: Any) -> Episode:
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != 2:
        raise ConfigurationError(f"episode {index} is no pair (observations, actions): {given!r}")
    observations = float_array(f"observations of episode {index}", given[0])
    actions = float_array(f"actions of episode {index}", given[1])
    if actions.ndim == 1:
        actions = actions[:, None]
    steps = len(actions)
    if observations.ndim != 2 or actions.ndim != 2 or not steps or len(observations) != steps + 1:
        raise ConfigurationError(
            f"episode {index}: expected observations of shape (T + 1, n) and actions of shape (T, m) with T of at "
            f"least 1, got {observations.shape} and {actions.shape}"
        )
    for name, array in (("observations", observations), ("actions", actions)):
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        if len(bad):
            raise ConfigurationError(
                f"{name} of episode {index} are not finite at step {bad[0]}: {array[bad[0]]}; end the episode before"
            )
    return Episode(observations, actions)


Model = Callable[[Array, Array], Array]
"""The states after a step, shape (k, n), from states, shape (k, n), and controls, shape (k, m)."""


def measured(measure: Measure, observation: Array) -> float:
    """A measure of an observation alone."""
    return float(measure(View(None, observation, {})))


def shortfalls(
    model: Model, episodes: Sequence[Episode], places: Array, horizon: int, measure: Measure
) -> Array:
    """Predicted minus true measure after each step of one window per episode, shape (episodes, horizon).

    Within a window the model is rolled out from the first true observation with the logged actions, and sees no other
    observation. A window lies where `places` says; in an episode shorter than the horizon it is the whole episode.

    Args:
        model: Rolled out.
        episodes: One for every window; the same one may be there several times.
        places: In [0, 1), shape (episodes,): from the first to the last place of a window.
        horizon: Steps.
        measure: See `RolloutPlant.margins`.

    Returns:
        inf where a measure is not a number, -inf after an episode's end.
    """
    lengths = np.array([len(one.actions) for one in episodes])
    starts = np.floor(places * (np.maximum(lengths - horizon, 0) + 1)).astype(int)
    states = np.array([one.observations[start] for one, start in zip(episodes, starts, strict=True)])
    found = np.full((len(episodes), horizon), -np.inf)
    for step in range(horizon):
        at = starts + step
        alive = np.flatnonzero(at < lengths).tolist()
        if not alive:
            break
        controls = np.array([episodes[i].actions[at[i]] for i in alive])
        with np.errstate(over="ignore", invalid="ignore"):  # a bad model may diverge, which is measured here
            states[alive] = model(states[alive], controls)
        for i in alive:
            true = measured(measure, episodes[i].observations[at[i] + 1])
            found[i, step] = _shortfall(measured(measure, states[i]), true)
    return found


def _shortfall(predicted: float, true: float) -> float:
    if predicted == true:  # infinite ones, too
        return 0.0
    fall = predicted - true
    return np.inf if np.isnan(fall) else fall
