"""What a constraint hands to the search may be nonsense: what is not finite, or outside the box, is not executed."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw


class Careless(sw.Constraint):
    """Admits everything but the proposal of 0.9, and offers nonsense."""

    def __init__(self, offered):
        self.offered = offered

    def bind(self, plant):
        return BoundCareless(self, plant)


class BoundCareless(sw.BoundConstraint):
    predicts = True
    judged = ()

    def admits(self, control):
        self.judged = (*self.judged, *control.tolist())
        return not np.any(control == np.float32(0.9))

    def slack(self, control):
        return 0.0 if self.admits(control) else -1.0

    def candidates(self, control):
        return [np.full(2, self.spec.offered)]

    def backup(self):
        return np.full(2, self.spec.offered)


@pytest.mark.parametrize("offered", [np.nan, np.inf, -np.inf, 5.0])
def test_candidates_and_backups_are_boxed_and_finite_before_they_are_judged(offered):
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [Careless(offered)])
    env.reset(seed=0)
    info = env.step(np.full(2, 0.9, np.float32))[4]
    assert np.isfinite(info["executed_action"]).all() and (np.abs(info["executed_action"]) <= 1.0).all()
    assert info["cbf/intervened"]
    judged = np.array(env.filter.bound[0].judged)
    assert np.isfinite(judged).all() and (np.abs(judged) <= 1.0).all()
