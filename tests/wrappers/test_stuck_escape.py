"""StuckEscape in closed loops on real envs."""

import gymnasium as gym
import numpy as np
import pytest
from worlds import Cart, SpeedRow, cart_plant

import safe_wrappers as sw
from safe_wrappers import info as keys

BEFORE_A_HAZARD = {"agent": [0, 0, 0], "hazards": [[0.5, 0.0]], "goal": [1.3, 0.0]}
PUSH = np.array([1.0, 0.0], dtype=np.float32)


def pushing(escape_s, seed=0, steps=400, **more):
    """The point robot pushes against a hazard without a detour; infos, rewards and the env."""
    env = sw.protect(gym.make("SafePointGoal1-v0"), detour=False)
    env = sw.StuckEscape(env, after_s=1.0, progress=0.05, escape_s=escape_s, **more)
    env.reset(seed=seed, options={"layout": BEFORE_A_HAZARD})
    infos, rewards = [], []
    for _ in range(steps):
        _, reward, _, _, info = env.step(PUSH)
        infos.append(info)
        rewards.append(reward)
    return infos, rewards, env


def test_stuck_is_what_its_definition_says():
    infos, rewards, _ = pushing(escape_s=0.0)
    window, found = 50, []
    for k in range(len(infos)):
        last = slice(k + 1 - window, k + 1)
        full = k + 1 >= window
        changed = full and sum(i[keys.CBF_INTERVENED] for i in infos[last]) > window / 2
        found.append(bool(changed and sum(rewards[last]) <= 0.05))
    assert [i[keys.CBF_STUCK] for i in infos] == found
    assert 100 < sum(found) < 350
    assert not any(i[keys.CBF_ESCAPING] for i in infos)


def test_reporting_alone_changes_nothing():
    env = sw.protect(gym.make("SafePointGoal1-v0"), detour=False)
    env.reset(seed=0, options={"layout": BEFORE_A_HAZARD})
    for info in pushing(escape_s=0.0)[0]:
        same = env.step(PUSH)[4]
        assert all(np.array_equal(info[key], same[key]) for key in same)


def test_a_drawn_action_is_held_filtered_and_not_counted_as_the_filters_change():
    infos, _, _ = pushing(escape_s=0.5)
    escaping = [i[keys.CBF_ESCAPING] for i in infos]
    began = escaping.index(True)
    assert infos[began - 1][keys.CBF_STUCK]
    assert escaping[began : began + 25] == [True] * 25
    assert not escaping[began + 25]
    drawn = infos[began][keys.PROPOSED_ACTION]
    assert not np.array_equal(drawn, PUSH)
    for info in infos[began : began + 25]:
        np.testing.assert_array_equal(info[keys.PROPOSED_ACTION], drawn)
        away = np.linalg.norm(info[keys.EXECUTED_ACTION] - drawn)
        assert info[keys.CBF_CORRECTION] == pytest.approx(away, abs=1e-12)
        assert info[keys.CBF_INTERVENED] == (away > 0.0)
    free = [i for i in infos if i[keys.CBF_ESCAPING] and not i[keys.CBF_INTERVENED]]
    assert len(free) > 10
    assert not any(i["cost_substep"] for i in infos)
    alone = pushing(escape_s=0.0)[0]
    assert sum(i[keys.CBF_STUCK] for i in infos) < sum(i[keys.CBF_STUCK] for i in alone)


def test_a_learner_is_told_that_its_action_was_replaced():
    env = sw.protect(gym.make("SafePointGoal1-v0"), detour=False)
    env = sw.StuckEscape(env, after_s=1.0, progress=0.05, escape_s=0.5)
    env = sw.AdaptionPenalty(env, penalty=0.1)
    env.reset(seed=0, options={"layout": BEFORE_A_HAZARD})
    infos = [env.step(PUSH)[4] for _ in range(200)]
    escaping = [i for i in infos if i[keys.CBF_ESCAPING]]
    assert any(not info[keys.CBF_INTERVENED] for info in escaping)
    assert {info[keys.ADAPTION_PENALTY] for info in escaping} == {0.1}


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_policy_that_is_not_finite_while_it_acts_is_counted(bad):
    _, _, env = pushing(escape_s=2.0, steps=100)
    info = env.step(np.array([bad, 0.5], dtype=np.float32))[4]
    assert info[keys.CBF_ESCAPING] and info[keys.CBF_NONFINITE]
    assert np.isfinite(info[keys.EXECUTED_ACTION]).all()


@pytest.mark.parametrize("paid", [0.0, 1.0])
def test_a_policy_that_makes_progress_is_not_stuck(paid):
    """The filter holds the cart's speed down at every step; stuck it is only where that pays nothing."""
    cart = gym.wrappers.TransformReward(Cart(), lambda _: paid)
    env = sw.StuckEscape(
        sw.CBFActionFilter(cart, [SpeedRow(0.25)], plant=cart_plant()), after_s=0.5, escape_s=0
    )
    env.reset(seed=0)
    infos = [env.step(np.ones(1, dtype=np.float32))[4] for _ in range(30)]
    assert infos[-1][keys.CBF_INTERVENED]
    assert infos[-1][keys.CBF_STUCK] == (paid == 0.0)
