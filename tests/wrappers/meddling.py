"""A wrapper that no monitor can replay."""

import gymnasium as gym


class Meddling(gym.Wrapper):
    """Writes to the env's data after some steps: adds to its first velocity, and sets fields of its contacts."""

    def __init__(self, env, at, velocity=1e-3, **contact):
        super().__init__(env)
        self.at, self.velocity, self.contact, self.steps = at, velocity, contact, 0

    def step(self, action):
        out = super().step(action)
        self.steps += 1
        if self.steps in self.at:
            self.unwrapped.data.qvel[0] += self.velocity
            for field, value in self.contact.items():
                getattr(self.unwrapped.data.contact, field)[:] = value
        return out
