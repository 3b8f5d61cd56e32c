"""Bound constraints whose every answer is given, and a search over two controls in [-1, 1]."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.fallback import Fallback
from safe_wrappers.filter.search import SafeActionSearch

LAST = np.zeros(2)


class Still(gym.Env):
    """Two controls, and a state that never changes."""

    dt = 0.1
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float64)
    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action):
        return np.zeros(1), 0.0, False, False, {}


class StillPlant(sw.AnalyticPlant):
    """Its state never changes; controls act between `acting`, or all between the bounds."""

    acting_range = None


def still_plant(acting=None):
    plant = StillPlant(lambda x: 0.0 * x, lambda x: np.zeros((1, 2)), lambda env: np.zeros(1))
    plant.acting_range = acting and tuple(map(np.array, acting))
    return plant


def half_spaces(*rows):
    """Rows ((a0, a1), b): a . u <= b."""
    return sw.HalfSpaces(
        np.array([a for a, _ in rows], float).reshape(-1, 2), np.array([b for _, b in rows], float)
    )


class Given(Bound):
    """It observes nothing and remembers nothing."""

    spec, plant, least, may_back_up = SimpleNamespace(scale=1.0, info_keys=()), None, np.inf, False

    def observe(self, memory):
        pass

    def executed(self, control):
        return {}

    def candidates(self, control):
        return ()

    def backup(self):
        return None


class Rows(Given):
    """Rows alone."""

    predicts, rows_decide = False, True

    def __init__(self, *rows):
        self._own = half_spaces(*rows)

    def admits(self, control):
        return bool((self._own.normals @ control <= self._own.offsets + 1e-9).all())

    def rows(self):
        return self._own


class Predicting(Given):
    """A slack of the control is all that counts; rows, tangents, candidates and backup are given.

    Args:
        slack: Control (2,) to its slack.
        guess: Rows that the search takes for a guess.
        tangents: Refused control to rows; None: it cannot be linearised.
        candidates: Controls to try first.
        control: The backup control, or None.
        scale: Of the slack.
    """

    predicts, rows_decide = True, False

    def __init__(self, slack, guess=(), tangents=None, candidates=(), control=None, scale=1.0):
        self.spec, self.may_back_up = SimpleNamespace(scale=scale, info_keys=()), control is not None
        self._slack, self._guess, self._tangents = slack, half_spaces(*guess), tangents
        self._candidates, self._control = candidates, control

    def admits(self, control):
        return self.slack(control) >= -1e-9

    def keeps_limit(self, control):
        return False

    def slack(self, control):
        return float(self._slack(control))

    def rows(self):
        return self._guess

    def linearize(self, control):
        return half_spaces(*(() if self._tangents is None else self._tangents(control)))

    def candidates(self, control):
        return [np.array(c) for c in self._candidates]

    def backup(self):
        return None if self._control is None else np.array(self._control)


def only(*controls):
    """A slack that admits these controls and no others."""
    return lambda u: 1.0 if any(np.allclose(u, c, atol=1e-6) for c in controls) else -1.0


def search(*constraints, fallback="brake", acting=None):
    plant = still_plant(acting)
    plant.bind(Still())
    plant.observe()
    low, high = -np.ones(2), np.ones(2)
    return SafeActionSearch(plant, constraints, Fallback(fallback, constraints), low, high)


def decide(proposal, *constraints, **options):
    return search(*constraints, **options).decide(np.array(proposal, float), LAST)
