"""SafeActionMap and StuckEscape in closed loops on real envs, and in closed form on a cart."""

import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from worlds import BoundSpeedRow, Cart, SpeedRow, cart_plant

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError

LIMIT, DT = 0.25, 0.1
POINT, ARM = "SafePointGoal1-v0", "Reacher-v5"


class BackedRow(SpeedRow):
    """The same, and it knows that braking keeps it."""

    def bind(self, plant):
        return BoundBackedRow(self, plant)


class BoundBackedRow(BoundSpeedRow):
    def backup(self):
        return np.array([self.spec.back])


def limited(limit=LIMIT, dtype=np.float32, back=-0.5, env=None):
    """A cart that may not be faster, and what it is given."""
    row = BackedRow(limit)
    object.__setattr__(row, "back", back)
    return sw.CBFActionFilter(env or Cart(dtype=dtype), [row], plant=cart_plant())


def seeking(env, rng):
    """Towards the nearest hazard, or any action at all."""
    task = env.unwrapped
    if not hasattr(task, "hazard_positions") or rng.random() < 0.3:
        return rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
    away = task.hazard_positions - task.agent_position
    nearest = away[np.argmin(np.linalg.norm(away, axis=1))]
    angle = math.remainder(math.atan2(nearest[1], nearest[0]) - task.agent_heading, math.tau)
    return np.array([rng.uniform(0.3, 1.0), np.clip(3.0 * angle + rng.normal(0.0, 0.3), -1, 1)], np.float32)


@pytest.mark.parametrize("task", [POINT, ARM])
def test_what_is_mapped_is_never_changed_by_the_filter(task):
    env = sw.SafeActionMap(sw.protect(gym.make(task, max_episode_steps=150)))
    rng = np.random.default_rng(0)
    scaled = unchanged = 0
    for seed in range(4):
        env.reset(seed=seed)
        over, held = False, None
        while not over:
            if held is None or rng.random() < 0.2:
                held = seeking(env, rng)
            _, _, _, over, info = env.step(held)
            assert not info[keys.MAP_SCALE] < 0.0 and not info[keys.MAP_SCALE] > 1.0
            assert not info.get("cost_substep", 0.0)
            if not np.isnan(info[keys.MAP_SCALE]):
                assert not info[keys.CBF_INTERVENED] and not info[keys.CBF_REFUSED].any()
                np.testing.assert_array_equal(info[keys.EXECUTED_ACTION], info[keys.PROPOSED_ACTION])
            if info[keys.MAP_SCALE] == 1.0:
                np.testing.assert_array_equal(info[keys.PROPOSED_ACTION], held)
                unchanged += 1
            scaled += info[keys.MAP_SCALE] < 1.0
    assert scaled > 20 and unchanged > 20


@pytest.mark.parametrize("task", [POINT, ARM])
def test_actions_on_a_ray_are_executed_in_their_order(task):
    env = sw.SafeActionMap(sw.protect(gym.make(task, max_episode_steps=250)))
    rng = np.random.default_rng(1)
    compared = 0
    for seed in range(3):
        env.reset(seed=seed)
        over = False
        while not over:
            # Beyond the acting range all forces are the same.
            action = np.clip(seeking(env, rng), *env.get_wrapper_attr("plant").acting_range)
            action = action.astype(np.float32)
            middle, scale = env.mapped(action)
            if 0.05 < scale < 0.95:
                # The anchor is on the line through both: action - middle = (1 - scale) (action - anchor).
                start = action - (action - np.asarray(middle, float)) / (1.0 - scale)
                parts = [start + t * (action - start) for t in (0.2, 0.5, 0.8, 1.0)]
                far = [np.linalg.norm(env.mapped(part.astype(np.float32))[0] - start) for part in parts]
                assert (np.diff(far) > 0.0).all()
                compared += 1
            over = env.step(action)[3]
    assert compared > 20


def test_in_closed_form_on_a_cart():
    env = sw.SafeActionMap(limited())
    speed = env.reset(seed=0)[0][1]
    rng = np.random.default_rng(0)
    scaled = 0
    for action in rng.uniform(-0.6, 1.0, (200, 1)).astype(np.float32):
        # The filter admits pushes up to the one that reaches the limit; the anchor is in the middle.
        most = min((LIMIT - speed) / DT, 1.0)
        anchor = 0.5 * (most - 1.0)
        share = min(1.0, (most - anchor) / (1.0 - anchor)) if action[0] > anchor else 1.0
        observation, *_, info = env.step(action)
        expected = anchor + share * (float(action[0]) - anchor)
        assert float(env.unwrapped.given[-1][0]) == pytest.approx(expected, abs=0.012)
        assert info[keys.MAP_SCALE] == pytest.approx(share, abs=0.012)
        assert not info[keys.CBF_INTERVENED]
        scaled += share < 1.0
        speed = observation[1]
    assert 50 < scaled < 200


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_where_everything_is_admitted_the_action_itself_is_executed(dtype):
    plain, mapped = limited(1e6, dtype), sw.SafeActionMap(limited(1e6, dtype))
    rng = np.random.default_rng(0)
    plain.reset(seed=0), mapped.reset(seed=0)
    for action in rng.uniform(-1.0, 1.0, (50, 1)).astype(dtype):
        one, two = plain.step(action), mapped.step(action)
        assert one[0].tobytes() == two[0].tobytes()
        assert mapped.unwrapped.given[-1] is action
        assert two[4].pop(keys.MAP_SCALE) == 1.0
        assert str(one[4]) == str(two[4])


def test_without_an_admitted_anchor_the_filter_gets_the_action_and_info_tells_it():
    plain, mapped = limited(0.05, back=1.0), sw.SafeActionMap(limited(0.05, back=1.0))
    plain.reset(seed=0), mapped.reset(seed=0)
    for _ in range(10):
        *_, one = plain.step(np.ones(1, np.float32))
        *_, two = mapped.step(np.ones(1, np.float32))
        np.testing.assert_array_equal(one[keys.EXECUTED_ACTION], two[keys.EXECUTED_ACTION])
    assert two[keys.CBF_INTERVENED] and np.isnan(two[keys.MAP_SCALE])


def test_what_is_not_finite_goes_to_the_filter():
    env = sw.SafeActionMap(limited())
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="not finite"):
        *_, info = env.step(np.array([np.nan], np.float32))
    assert info[keys.CBF_NONFINITE] and np.isnan(info[keys.MAP_SCALE])
    env.unwrapped.state[:] = np.nan
    with warnings.catch_warnings(action="ignore"):
        *_, info = env.step(np.array([1.0], np.float32))
    assert info[keys.CBF_UNSAFE] and info[keys.CBF_FALLBACK] and np.isnan(info[keys.MAP_SCALE])


class Twice(gym.ActionWrapper):
    def action(self, action):
        return 2.0 * action


class Endless(Cart):
    def __init__(self):
        super().__init__()
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: sw.SafeActionMap(Cart()), "needs a CBFActionFilter inside"),
        (lambda: sw.SafeActionMap(Twice(limited())), r"outside: Twice\(SafeActionMap\(env"),
        (lambda: sw.SafeActionMap(limited(env=Endless())), "finite bounds"),
        (
            lambda: sw.SafeActionMap(sw.CBFActionFilter(Cart(), [SpeedRow(LIMIT)], plant=cart_plant())),
            "knows a backup control",
        ),
        (lambda: sw.SafeActionMap(sw.SafeActionMap(limited())), "mapped already"),
    ],
)
def test_what_it_refuses(build, message):
    with pytest.raises(ConfigurationError, match=message):
        build()


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
    """The penalty is by how far the executed action is from the policy's, as where the filter changed it."""
    env = sw.protect(gym.make("SafePointGoal1-v0"), detour=False)
    env = sw.StuckEscape(env, after_s=1.0, progress=0.05, escape_s=0.5)
    env = sw.AdaptionPenalty(env, penalty=0.1, per_correction=2.0)
    env.reset(seed=0, options={"layout": BEFORE_A_HAZARD})
    infos = [env.step(PUSH)[4] for _ in range(200)]
    escaping = [i for i in infos if i[keys.CBF_ESCAPING]]
    assert escaping
    for info in escaping:
        away = np.linalg.norm(info[keys.EXECUTED_ACTION] - PUSH)
        assert info[keys.ADAPTION_PENALTY] == pytest.approx(0.1 + 2.0 * away)


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


def test_refused():
    env = gym.make("SafePointGoal1-v0")
    with pytest.raises(sw.SafeWrappersError, match="needs a CBFActionFilter inside"):
        sw.StuckEscape(env)
    env = sw.protect(env)
    for arguments in ({"after_s": 0.0}, {"escape_s": -1.0}, {"progress": np.nan}):
        with pytest.raises(sw.SafeWrappersError, match=next(iter(arguments))):
            sw.StuckEscape(env, **arguments)
    with pytest.raises(sw.SafeWrappersError, match="use one"):
        sw.StuckEscape(sw.StuckEscape(env))
    with pytest.raises(sw.SafeWrappersError, match="put it outside"):
        sw.LeaseExpiry(sw.StuckEscape(env), env.constraints[0])
