"""A constraint on a plant, asked at whatever state the plant has observed; the plainest one; analytic plants."""

from dataclasses import dataclass
from operator import attrgetter

import numpy as np

import safe_wrappers as sw
from safe_wrappers.filter.bound import Bound


@dataclass
class Below(sw.Constraint):
    """One state stays below a limit at the end of the hold, and its rate is the control: rows alone, no h."""

    limit: float
    of: int = 0

    def rows(self):
        left = self.limit - self.plant.state[self.of]
        return sw.HalfSpaces(np.array([[self.plant.control_dt]]), np.array([left]))


def falling(x):
    return np.array([x[1], 15.0 * np.sin(x[0])])


def torque(x):
    return np.array([[0.0], [3.0]])


def pendulum_plant():
    """Of Pendulum-v1; it can be pickled."""
    return sw.AnalyticPlant(falling, torque, attrgetter("state"), control_dt=0.05)


def pushed(state, push=(1.0,), **timing):
    """Of x'' = push . u; the state of an env is (x, x')."""
    effect = np.array([np.zeros(len(push)), push])
    return sw.AnalyticPlant(lambda x: np.array([x[1], 0.0]), lambda x: effect, state, **timing)


def bound(env, **options):
    """A MujocoPlant, bound to an env."""
    plant = sw.MujocoPlant(**options)
    plant.bind(env)
    return plant


def asked(env, constraint, plant=None):
    """A constraint on a plant that has observed the env's present state."""
    plant = plant or sw.MujocoPlant()
    plant.bind(env)
    plant.observe()
    return Asked(constraint, plant)


def settled(env, constraint, control, steps=60):
    """A constraint on a plant that observes the env after the control has acted for some steps."""
    plant = bound(env)
    env.reset()
    for _ in range(steps):
        env.step(control)
    plant.observe()
    return Asked(constraint, plant)


class Asked:
    """A bound constraint that observes by itself when the plant has, with the memory of an episode.

    `executed` closes a step, as the filter does. Everything else is the bound constraint's own, or its
    specification's.
    """

    def __init__(self, constraint, plant):
        self.bound, self.plant = Bound(constraint, plant), plant
        self.memory, self.seen = {}, None

    def executed(self, control):
        self.memory = self.bound.executed(control)

    def start(self):
        self.memory, self.seen = {}, None

    def __getattr__(self, name):
        if self.seen != self.plant.observation_id:
            self.seen = self.plant.observation_id
            self.bound.observe(self.memory)
        return getattr(self.bound if hasattr(self.bound, name) else self.bound.spec, name)
