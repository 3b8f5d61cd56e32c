"""Fitted dynamics: a linear system is found again, and networks know a pendulum better."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.plants.identified.models import EnsembleModel, LinearModel


def steps_of(episodes):
    states = np.concatenate([one.observations[:-1] for one in episodes])
    after = np.concatenate([one.observations[1:] for one in episodes])
    return states, np.concatenate([one.actions for one in episodes]), after


def test_a_linear_system_is_found_again():
    draw = np.random.default_rng(0)
    a, b, c = draw.normal(size=(4, 4)), draw.normal(size=(2, 4)), draw.normal(size=4)
    states, controls = draw.normal(size=(100, 4)) * [1.0, 100.0, 0.01, 1.0], draw.normal(size=(100, 2))
    after = states @ a + controls @ b + c
    model = LinearModel(states, controls, after - states)
    np.testing.assert_allclose(model.weights, np.vstack([a - np.eye(4), b, c]), atol=1e-9)
    new = draw.normal(size=(5, 4)), draw.normal(size=(5, 2))
    np.testing.assert_allclose(model(*new), new[0] @ a + new[1] @ b + c, atol=1e-9)


def test_networks_know_a_pendulum_better_and_the_same_seed_gives_the_same():
    torch = pytest.importorskip("torch")
    threads = torch.get_num_threads()
    logs = sw.plants.log_steps(gym.make("Pendulum-v1"), episodes=20, seed=0)
    states, controls, after = steps_of(logs[:10])
    fitted = EnsembleModel(states, controls, after - states, seed=0)
    assert torch.get_num_threads() == threads
    linear = LinearModel(states, controls, after - states)
    states, controls, after = steps_of(logs[10:])
    errors = [np.sqrt(((model(states, controls) - after) ** 2).mean()) for model in (fitted, linear)]
    assert errors[0] < 0.2 * errors[1]
    # One state at a time is the same as all at once.
    np.testing.assert_allclose(fitted(states[:1], controls[:1]), fitted(states, controls)[:1], atol=1e-12)


def test_a_number_that_never_changes_does_no_harm(monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.setattr("safe_wrappers.plants.identified.models._UPDATES", 20)
    draw = np.random.default_rng(0)
    states = np.column_stack([draw.normal(size=50), np.full(50, 0.3)])
    changes = np.column_stack([draw.normal(size=50), np.zeros(50)])
    model = EnsembleModel(states, draw.normal(size=(50, 1)), changes, seed=0)
    found = model(states, np.zeros((50, 1)))
    assert np.isfinite(found).all() and np.abs(found[:, 1] - 0.3).max() < 2.0
