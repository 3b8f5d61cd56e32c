"""A constraint on a plant, asked at whatever state the plant has observed."""


class Asked:
    """A bound constraint that observes by itself when the plant has, with the memory of an episode.

    `executed` closes a step, as the filter does. Everything else is the bound constraint's own.
    """

    def __init__(self, constraint, plant):
        self.bound, self.plant = constraint.bind(plant), plant
        self.memory, self.seen = self.bound.start(), None

    def executed(self, control):
        self.memory = self.bound.executed(control)

    def start(self):
        self.memory, self.seen = self.bound.start(), None

    def __getattr__(self, name):
        if self.seen != self.plant.observation_id:
            self.seen = self.plant.observation_id
            self.bound.observe(self.memory)
        return getattr(self.bound, name)
