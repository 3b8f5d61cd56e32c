"""A constraint on a plant, asked at whatever state the plant has observed."""

import safe_wrappers as sw
from safe_wrappers.filter.bound import Bound


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
