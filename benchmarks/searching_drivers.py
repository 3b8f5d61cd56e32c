"""Drivers that search: they roll sequences of actions out in copies of the env, filter included; the worst is made.

A sequence is worth the lowest margin on its way, less 1 if the task reports a violation: the lower, the better for
the attacker. Sequences are given by a few knots, each of which is held. Actions are cubes of what is searched, in
shares of the action box, because motors saturate at hundredths of it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from safe_wrappers.errors import Array
from safe_wrappers.plants.copies import EnvCopier

Score = Callable[[Array], float]
Search = Callable[[Score, Array, np.random.Generator], Array]

HORIZON, KNOTS, EXECUTED = 30, 6, 10
"""Control steps that are looked ahead, knots of a sequence, and steps of it that are made before the next search."""


def cross_entropy(score: Score, start: Array, rng: np.random.Generator) -> Array:
    """CEM: three rounds of a dozen sequences about the mean of the best three of the round before."""
    mean, spread = start, np.full(start.shape, 0.5)
    found: list[tuple[float, Array]] = []
    for _ in range(3):
        drawn = np.clip(mean + spread * rng.normal(size=(12, *start.shape)), -1.0, 1.0)
        ranked = sorted(((score(knots), knots) for knots in drawn), key=lambda pair: pair[0])
        found.append(ranked[0])
        best = np.array([knots for _, knots in ranked[:3]])
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.1
    return min(found, key=lambda pair: pair[0])[1]


def differences(score: Score, start: Array, rng: np.random.Generator) -> Array:
    """Two steps down a gradient by forward differences from a start that is shaken; the best of the three points."""
    knots = np.clip(start + rng.normal(0.0, 0.3, start.shape), -1.0, 1.0)
    found = [(score(knots), knots)]
    for length in (0.6, 0.3):
        slope = np.zeros(knots.size)
        for i in range(knots.size):
            nudge = 0.25 * np.eye(knots.size)[i].reshape(knots.shape)
            slope[i] = score(knots + nudge) - found[-1][0]
        steepest = max(float(np.abs(slope).max()), 1e-12)
        knots = np.clip(knots - length * slope.reshape(knots.shape) / steepest, -1.0, 1.0)
        found.append((score(knots), knots))
    return min(found, key=lambda pair: pair[0])[1]


class SearchingDriver:
    """Searches anew every `EXECUTED` steps.

    Args:
        env: With its filter, in an episode.
        rng: Of the searches.
        search: `cross_entropy` or `differences`.

    Attributes:
        simulated: Steps in copies so far; `simulated_violations`: those of them whose task reported one.
    """

    def __init__(self, env: Any, rng: np.random.Generator, search: Search) -> None:
        self._env, self._rng, self._search = env, rng, search
        self._copier, self._time = EnvCopier(env), np.inf
        self._knots = np.zeros((KNOTS, *env.action_space.shape))
        self._left: list[Array] = []
        self.simulated = self.simulated_violations = 0

    def __call__(self) -> Array:
        """The next action."""
        time = self._env.unwrapped.data.time
        if time < self._time:  # another episode
            self._copier.start()
            self._knots[:], self._left = self._rng.uniform(-1.0, 1.0, self._knots.shape), []
        self._time = time
        if not self._left:
            self._knots = self._search(self._score, self._knots, self._rng)
            self._left = list(self._actions(self._knots)[:EXECUTED])
            self._knots = np.roll(self._knots, -KNOTS * EXECUTED // HORIZON, axis=0)
        return self._left.pop(0)

    def _actions(self, knots: Array) -> Array:
        space = self._env.action_space
        cubes = (np.clip(knots, -1.0, 1.0) ** 3 + 1.0) / 2.0
        held = np.repeat(cubes, HORIZON // KNOTS, axis=0)
        return np.asarray(space.low + held * (space.high - space.low), dtype=space.dtype)

    def _score(self, knots: Array) -> float:
        env, lowest = self._copier.copy(), np.inf
        for action in self._actions(knots):
            info = env.step(action)[4]
            violated = bool(info.get("cost_substep", 0.0))
            self.simulated += 1
            self.simulated_violations += violated
            lowest = min(lowest, info["cbf/margin"] - violated)
        return float(lowest)


SEARCHES: dict[str, Search] = {"CEM": cross_entropy, "differences": differences}
