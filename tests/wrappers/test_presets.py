"""ActionShield on grids whose safe actions are known; WholeBodyFilter: its constraints, and hostile states."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.constraints import PredictiveShield
from safe_wrappers.plants.mujoco.contacts import Replay

sys.path.append(str(Path(__file__).parents[1] / "plants" / "simulator"))
from simulated_worlds import GRID, MOVES, Grid

EVERY = [0, 1, 2, 3]


def shielded(env=None, cost="cost", **options):
    env = sw.ActionShield(env or Grid(), [PredictiveShield(cost, 2, backup=EVERY, **options)])
    env.reset(seed=0)
    return env


def pits(at):
    """Which moves lead into a pit, from the map."""
    column, row = at
    led = [(min(max(column + dx, 0), 3), min(max(row + dy, 0), 3)) for dx, dy in MOVES]
    return np.array([GRID[y][x] == "#" for x, y in led])


def test_masks_are_the_moves_that_do_not_lead_into_a_pit():
    env, rng, refused = shielded(), np.random.default_rng(0), 0
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
    env = shielded(value=lambda o, a: -np.abs(a[:, 0] - 3.0))
    env.step(1)
    info = env.step(2)[4]
    assert info["cbf/intervened"]
    assert info["executed_action"][0] == max(np.flatnonzero(~pits((0, 1))), key=lambda a: -abs(a - 3))


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
def test_if_nothing_is_admitted_that_is_said_and_one_action_is_left():
    env = shielded(cost=lambda o: -1.0 - o[0])
    assert env.action_masks().sum() == 1
    info = env.step(2)[4]
    assert info["cbf/infeasible"] and info["cbf/fallback"] and info["executed_action"][0] in (0.0, 1.0, 3.0)


class Blind(Grid):
    blind = False

    def step(self, action):
        observation, *rest = super().step(action)
        return (observation + np.nan if self.blind else observation), *rest


def test_a_state_that_is_not_a_number_lets_the_last_action_go_on():
    env = shielded(Blind())
    env.step(2)
    env.unwrapped.blind = True
    with pytest.warns(sw.UnsafeStateWarning):
        env.step(2)
        assert env.action_masks().tolist() == [True] * 4
        info = env.step(1)[4]
    assert info["executed_action"] == [2.0] and info["cbf/fallback"]


def test_maskable_ppo_reads_the_masks():
    contrib = pytest.importorskip("sb3_contrib")
    env = sw.RecordInterventions(gym.wrappers.TimeLimit(shielded(), 40))
    model = contrib.MaskablePPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0, device="cpu")
    seen = []

    def count(local, _):
        seen.extend(info["cbf/intervened"] for info in local["infos"])
        return True

    model.learn(128, callback=count)
    assert len(seen) >= 128 and not any(seen)


# Legs -----------------------------------------------------------------------------------------------------------


def flagged(info):
    return bool(info["cbf/infeasible"] or info["cbf/fallback"])


def test_a_whole_body_filter_is_these_constraints():
    env = sw.WholeBodyFilter(gym.make("Hopper-v5"), friction_share=0.6, zmp_inset=0.02, tolerance=0.03)
    contact, support, joints = env.constraints
    assert contact == sw.constraints.ContactFeasibility(0.6, 0.03)
    assert support == sw.constraints.SupportMargin(0.02)
    names = ["thigh_joint", "leg_joint", "foot_joint"]
    stops = np.array([env.unwrapped.model.joint(name).range for name in names])
    assert joints.joints == names and joints.horizon == 3
    np.testing.assert_allclose([joints.lower, joints.upper], stops.T + np.array([[-0.1], [0.1]]))
    (alone,) = sw.WholeBodyFilter(gym.make("Hopper-v5"), joint_tolerance=None).constraints
    assert alone == sw.constraints.ContactFeasibility(0.7, 0.01)


BROKEN = [
    ("qpos", np.nan), ("qvel", np.nan), ("qvel", np.inf), ("qvel", 1e11), ("qvel", 1e160), ("qvel", 1e300),
    ("qpos", 1e12),
]  # fmt: skip
"""States that are none, and states that MuJoCo resets."""
KINDS = {
    "forecast": sw.WholeBodyFilter,
    "pyramid": lambda env: sw.CBFActionFilter(env, [sw.constraints.Stance()]),
    "cone": lambda env: sw.CBFActionFilter(env, [sw.constraints.Stance(cone="exact")]),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("contacts", KINDS)
@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Walker2d-v5"])
def test_no_broken_state_passes_in_silence_and_no_broken_action_gets_through(env_id, contacts):
    env = KINDS[contacts](gym.make(env_id))
    for where, value in BROKEN:
        _, first = env.reset(seed=0)
        for _ in range(3):
            env.step(np.zeros(6, np.float32))
        getattr(env.unwrapped.data, where)[-1] = value
        info = env.step(np.full(6, 0.3, np.float32))[4]
        assert flagged(info), (where, value)
        assert env.action_space.contains(info["executed_action"].astype(np.float32))
        assert info.keys() >= first.keys()
        assert all(np.isfinite(info[key]).all() for key in first if "/" in key)
        assert info["whole_body/cone_margin"] <= 0.0
    env.reset(seed=0)
    for bad in (np.nan, np.inf, -np.inf, 1e30, 5.0):
        action = np.zeros(6)
        action[2] = bad
        info = env.step(action)[4]
        assert (np.abs(info["executed_action"]) <= 1.0).all()
        assert info["cbf/fallback"] == (not np.isfinite(bad)) or flagged(info)
        assert info["cbf/correction"] > 0.0


def test_joints_stay_off_their_stops_at_every_evaluation():
    def beyond(env, action):
        replay, worst = Replay(env.unwrapped), [-np.inf]

        def look(data, _):
            at = data.qpos[3:9]
            worst.append(float(np.maximum(low - at, at - high).max()))

        replay.before()
        info = env.step(action)[-1]
        assert replay.after(look)
        return max(worst) > 0.1 + 1e-6, info

    env, bare = sw.WholeBodyFilter(gym.make("HalfCheetah-v5")), gym.make("HalfCheetah-v5")
    low, high = env.unwrapped.model.jnt_range[3:9].T
    outside = dict.fromkeys((env, bare), 0)
    for each in outside:
        each.reset(seed=0)
        for k in range(40):
            action = np.sign(np.random.default_rng(k // 8).normal(size=6)).astype(np.float32)
            far, info = beyond(each, action)
            outside[each] += far
            assert not far or each is bare or flagged(info) or info["cbf/unsafe"]
    assert outside[bare] > outside[env]
