"""ActionShield on a grid whose safe actions are known; WholeBodyFilter: its constraints, and hostile states."""

import gymnasium as gym
import numpy as np
import pytest
from simulated_worlds import GRID, MOVES, Grid

import safe_wrappers as sw


def shielded(env=None, cost="cost", start=0, fallback="brake", **options):
    shield = sw.constraints.PredictiveShield(cost, 2, backup=[start + k for k in range(4)], **options)
    env = sw.ActionShield(env or Grid(), [shield], fallback=fallback)
    env.reset(seed=0)
    return env


def pits(at):
    """Which moves lead into a pit, from the map."""
    column, row = at
    led = [(min(max(column + dx, 0), 3), min(max(row + dy, 0), 3)) for dx, dy in MOVES]
    return np.array([GRID[y][x] == "#" for x, y in led])


@pytest.mark.parametrize(
    "prefers, start", [("the nearest", 0), ("the farthest", 0), ("the nearest", 5)], ids=str
)
def test_a_move_into_a_pit_is_masked_and_replaced_by_the_preferred_one(prefers, start):
    favourite = {"value": lambda o, a: np.abs(a[:, 0] - 3.0)} if prefers == "the farthest" else {}
    env = shielded(Grid(start), start=start, **favourite)
    rng, refused = np.random.default_rng(0), 0
    for _ in range(300):
        masks, move = env.action_masks(), int(rng.integers(4))
        np.testing.assert_array_equal(masks, ~pits(env.unwrapped.at))
        _, _, terminated, _, info = env.step(start + move)
        executed = int(info["executed_action"][0]) - start
        assert info["cbf/intervened"] == (not masks[move]) and info["cost"] == 0.0
        assert info["proposed_action"] == [start + move] and masks[executed]
        if info["cbf/intervened"]:
            admitted = np.flatnonzero(masks)
            away = 3 - admitted if favourite else -abs(admitted - move)
            assert away[admitted == executed] == away.max()
            refused += 1
        if terminated:
            env.reset()
    assert refused > 20


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
def test_if_nothing_is_admitted_that_is_said_and_what_violates_least_is_left():
    # h falls to the right: every move but that one is as bad as staying.
    env = shielded(cost=lambda o: -1.0 - o[0])
    assert env.action_masks().sum() == 1
    info = env.step(1)[4]
    assert info["cbf/infeasible"] and info["cbf/fallback"] and info["executed_action"][0] in (0.0, 2.0, 3.0)
    assert info["cbf/stage"] == 8
    info = shielded(cost=lambda o: -1.0 - o[0], fallback=lambda plant: [1.0]).step(3)[4]
    assert info["cbf/infeasible"] and info["executed_action"] == [1.0] and info["cbf/stage"] == 7


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


def test_maskable_ppo_reads_the_masks_through_a_vec_env():
    masking = pytest.importorskip("sb3_contrib.common.maskable.utils")
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env(lambda: sw.RecordInterventions(shielded()), 2)
    envs.reset()
    envs.step(np.array([1, 2]))
    assert masking.is_masking_supported(envs)
    np.testing.assert_array_equal(masking.get_action_masks(envs), ~np.array([pits((1, 0)), pits((0, 1))]))


# Legs -------------------------------------------------------------------------------------------------------------


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
    ("qpos", np.nan),
    ("qvel", np.nan),
    ("qvel", np.inf),
    ("qvel", 1e11),
    ("qvel", 1e300),
    ("qpos", 1e12),
]
"""States that are none, and states that MuJoCo resets."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "build",
    [
        sw.WholeBodyFilter,
        lambda env: sw.CBFActionFilter(env, [sw.constraints.Stance()]),
        lambda env: sw.CBFActionFilter(env, [sw.constraints.Stance(cone="exact")]),
    ],
    ids=["forecast", "pyramid", "cone"],
)
def test_no_broken_state_passes_in_silence_and_no_broken_action_gets_through(build):
    env = build(gym.make("Walker2d-v5"))

    def flagged(info):
        return bool(info["cbf/infeasible"] or info["cbf/fallback"])

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
