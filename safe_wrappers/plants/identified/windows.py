"""How much a measure falls below its prediction along logged episodes."""

from collections.abc import Callable, Sequence

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.plants.identified.logs import Episode
from safe_wrappers.plants.rollouts import Measure, View

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
