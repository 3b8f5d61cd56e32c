"""A backup manoeuvre of one's own: what BoundBackupClearance makes of three methods."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.constraints import BoundBackupClearance

WALL, BRAKE, DT = 10.0, 2.0, 0.1


@dataclass
class StopBefore(sw.Constraint):
    """A point of 1 kg that brakes with `brake` N before a wall."""

    margin: float = 0.01
    brake: float = BRAKE

    def bind(self, plant):
        return BoundStopBefore(self, plant)


class BoundStopBefore(BoundBackupClearance):
    def clearance(self):
        return np.array([self._left(*self.plant.state)])

    def _after(self, control):
        x, v = self.plant.state
        # A step that turns back reaches farthest on its way.
        turned = v**2 / (-2.0 * control[0]) if v > 0.0 and v + DT * control[0] < 0.0 else 0.0
        ends = x + DT * v + 0.5 * DT**2 * control[0], v + DT * control[0]
        return min(self._left(*ends), WALL - x - turned)

    def admits(self, control):
        left = self._after(control)
        return left >= self.spec.margin or left >= self._after(self.backup())

    def backup(self):
        return np.array([-min(self.spec.brake, max(self.plant.state[1], 0.0) / DT)])

    def _left(self, x, v):
        # In its last step the point brakes just to rest: up to an eighth of a step's change of speed longer.
        return WALL - x - max(v, 0.0) ** 2 / (2.0 * self.spec.brake) - 0.125 * BRAKE * DT**2 * (v > 0.0)


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


def test_what_loses_no_more_than_the_backup_is_admitted_where_the_margin_is_lost():
    with pytest.warns(sw.UnsafeStateWarning):
        _, bound = filtered((9.5, 2.0))
    backup = bound.backup()
    assert bound.value()[0] < 0.0
    assert bound.admits(backup) and bound.admits(backup - 1.0) and not bound.admits(backup + 0.1)
