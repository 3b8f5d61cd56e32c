"""ActionShield on grids whose safe actions are known."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.constraints import PredictiveShield

sys.path.append(str(Path(__file__).parents[1] / "plants" / "simulator"))
from simulated_worlds import GRID, MOVES, Grid

EVERY = [0, 1, 2, 3]


def grid(**options):
    return sw.ActionShield(Grid(), [PredictiveShield("cost", 2, backup=EVERY)], **options)


def pits(at):
    """Which moves lead into a pit, from the map."""
    column, row = at
    led = [(min(max(column + dx, 0), 3), min(max(row + dy, 0), 3)) for dx, dy in MOVES]
    return np.array([GRID[y][x] == "#" for x, y in led])


def test_masks_are_the_moves_that_do_not_lead_into_a_pit():
    env, rng, refused = grid(), np.random.default_rng(0), 0
    env.reset(seed=0)
    for _ in range(300):
        masks = env.action_masks()
        np.testing.assert_array_equal(masks, ~pits(env.unwrapped.at))
        action = int(rng.integers(4))
        _, _, terminated, _, info = env.step(action)
        assert info["cbf/intervened"] == (not masks[action]) and info["cost"] == 0.0
        assert masks[int(info["executed_action"][0])] and info["proposed_action"] == [action]
        refused += info["cbf/intervened"]
        if terminated:
            env.reset()
    assert refused > 20


def test_of_the_admitted_the_preferred_one_is_executed():
    liked = PredictiveShield("cost", 2, backup=EVERY, value=lambda o, a: -np.abs(a[:, 0] - 3.0))
    env = sw.ActionShield(Grid(), [liked])
    env.reset(seed=0)
    env.step(1)
    info = env.step(2)[4]
    assert info["cbf/intervened"]
    masks = ~pits((0, 1))
    assert info["executed_action"][0] == max(np.flatnonzero(masks), key=lambda a: -abs(a - 3))


def test_if_nothing_is_admitted_that_is_said_and_one_action_is_left():
    env = sw.ActionShield(Grid(), [PredictiveShield(lambda o: -1.0 - o[0], horizon=2, backup=EVERY)])
    with pytest.warns(sw.UnsafeStateWarning):
        env.reset(seed=0)
    masks = env.action_masks()
    assert masks.sum() == 1
    info = env.step(2)[4]
    assert info["cbf/infeasible"] and info["cbf/fallback"] and info["executed_action"][0] in (0.0, 1.0, 3.0)


def test_a_state_that_is_not_a_number_lets_the_last_action_go_on():
    class Blind(Grid):
        blind = False

        def step(self, action):
            observation, *rest = super().step(action)
            return (observation + np.nan if self.blind else observation), *rest

    env = sw.ActionShield(Blind(), [PredictiveShield("cost", 2, backup=EVERY)])
    env.reset(seed=0)
    env.step(2)
    env.unwrapped.blind = True
    with pytest.warns(sw.UnsafeStateWarning):
        env.step(2)
        assert env.action_masks().tolist() == [True] * 4
        info = env.step(1)[4]
    assert info["executed_action"] == [2.0] and info["cbf/fallback"]


def test_maskable_ppo_reads_the_masks():
    contrib = pytest.importorskip("sb3_contrib")
    env = sw.RecordInterventions(gym.wrappers.TimeLimit(grid(), 40))
    model = contrib.MaskablePPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0, device="cpu")
    seen = []

    def count(local, _):
        seen.extend(info["cbf/intervened"] for info in local["infos"])

    model.learn(128, callback=lambda local, other: count(local, other) or True)
    assert len(seen) >= 128 and not any(seen)
