"""A backup manoeuvre of one's own: a model that brakes, and what is made of it."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.plants.plant import Model, Trajectory

WALL, BRAKE, DT = 10.0, 2.0, 0.1


@dataclass
class StopBefore(sw.Constraint, Model):
    """A point of 1 kg that brakes with `brake` N before a wall."""

    margin: float = 0.01
    brake: float = BRAKE

    def setup(self, plant):
        self.plant, self.model = plant, self

    def rollout(self, control, horizon=1):
        states = [self.plant.state]
        if control is not None:
            states += self._held(states[-1], control[0])
        while states[-1][1] > 1e-9:
            states += self._held(states[-1], self._braking(states[-1]))
        return Trajectory(control, np.array(states))

    def _held(self, state, control):
        return [
            state + np.array([t * state[1] + 0.5 * t * t * control, t * control])
            for t in np.linspace(0.0, DT, 21)[1:]
        ]

    def _braking(self, state):
        return -min(self.brake, max(state[1], 0.0) / DT)

    def h_along(self, path):
        return WALL - path.states[:, :1]

    def proposals(self, control):
        return [np.array([self._braking(self.plant.state)])] if control is None else []


class Point(gym.Env):
    dt = DT
    action_space = gym.spaces.Box(-4.0, 4.0, (1,))
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([0.0, 0.0] if options is None else options["state"])
        return self.state, {}

    def step(self, action):
        x, v = self.state
        ways = [x + t * v + 0.5 * t * t * action[0] for t in np.linspace(0.0, DT, 21)]
        self.state = np.array([ways[-1], v + DT * action[0]])
        return self.state, 0.0, False, False, {"cost": float(max(ways) > WALL)}


def filtered(state=None, **fields):
    plant = sw.AnalyticPlant(
        f=lambda s: np.array([s[1], 0.0]),
        g=lambda s: np.array([[0.0], [1.0]]),
        state=lambda env: env.state,
        control_dt=DT,
    )
    env = sw.CBFActionFilter(Point(), [StopBefore(**fields)], plant)
    env.reset(seed=0, options=None if state is None else {"state": state})
    return env, env.filter.bound[0]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_nothing_is_violated_and_nothing_flagged_whatever_drives(seed):
    env, _ = filtered()
    rng, farthest, force = np.random.default_rng(seed), 0.0, 4.0
    for k in range(400):
        if seed and k % 7 == 0:
            force = rng.choice([4.0, 4.0, -4.0])
        info = env.step(np.array([force], np.float32))[4]
        assert not (info["cost"] or info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"])
        farthest = max(farthest, env.unwrapped.state[0])
    assert farthest > WALL - 0.1


def test_from_outside_what_the_backup_keeps_is_admitted_and_what_loses_more_is_not():
    with pytest.warns(sw.UnsafeStateWarning):
        _, bound = filtered((9.5, 2.0))
    backup = bound.backup()
    assert bound.value()[0] < 0.0
    assert bound.admits(backup) and bound.admits(backup - 1.0) and not bound.admits(backup + 0.1)
