"""What a constraint hands to the search may be nonsense: what is not finite, or outside the box, is not executed."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw


class Careless(sw.Constraint):
    """Admits everything but the proposal of 0.9, and offers nonsense."""

    def __init__(self, offered):
        self.offered = offered

    smooth = False
    recovery_s = 0.0
    judged = ()

    def h_along(self, path):
        if path.control is None:
            return np.ones((1, 1))
        self.judged = (*self.judged, *path.control.tolist())
        return np.array([[-1.0 if np.any(path.control == np.float32(0.9)) else 0.0]])

    def proposals(self, control):
        return [np.full(2, self.offered)]


@pytest.mark.parametrize("offered", [np.nan, np.inf, -np.inf, 5.0])
def test_candidates_and_backups_are_boxed_and_finite_before_they_are_judged(offered):
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [Careless(offered)])
    env.reset(seed=0)
    info = env.step(np.full(2, 0.9, np.float32))[4]
    assert np.isfinite(info["executed_action"]).all() and (np.abs(info["executed_action"]) <= 1.0).all()
    assert info["cbf/intervened"]
    judged = np.array(env.filter.bound[0].spec.judged)
    assert np.isfinite(judged).all() and (np.abs(judged) <= 1.0).all()
