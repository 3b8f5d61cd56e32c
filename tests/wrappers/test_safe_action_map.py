"""SafeActionMap in closed loops on real envs, and in closed form on a cart."""

import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from worlds import Cart, SpeedRow, cart_plant

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ActionError, ConfigurationError, UnknownNameError

LIMIT, DT = 0.25, 0.1
POINT, ARM = "SafePointGoal1-v0", "Reacher-v5"


def push_back(env):
    return [-0.5]


def retreat(env):
    """Full reverse of the point robot."""
    return [-1.0, 0.0]


def limited(limit=LIMIT, dtype=np.float32):
    """A cart that may not be faster, and what it is given."""
    return sw.CBFActionFilter(Cart(dtype=dtype), [SpeedRow(limit)], plant=cart_plant())


def seeking(env, rng):
    """Towards the nearest hazard, or any action at all."""
    task = env.unwrapped
    if not hasattr(task, "hazard_positions") or rng.random() < 0.3:
        return rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
    away = task.hazard_positions - task.agent_position
    nearest = away[np.argmin(np.linalg.norm(away, axis=1))]
    angle = math.remainder(math.atan2(nearest[1], nearest[0]) - task.agent_heading, math.tau)
    return np.array([rng.uniform(0.3, 1.0), np.clip(3.0 * angle + rng.normal(0.0, 0.3), -1, 1)], np.float32)


@pytest.mark.parametrize(
    ("task", "anchor"),
    [
        *((task, anchor) for task in (POINT, ARM) for anchor in ("centre", "backup", "closest")),
        (POINT, retreat),
    ],
)
def test_what_is_mapped_is_never_changed_by_the_filter(task, anchor):
    env = sw.SafeActionMap(sw.protect(gym.make(task, max_episode_steps=150)), anchor)
    rng = np.random.default_rng(0)
    scaled = unchanged = 0
    for seed in range(4):
        env.reset(seed=seed)
        over, held = False, None
        while not over:
            if held is None or rng.random() < 0.2:
                held = seeking(env, rng)
            _, _, _, over, info = env.step(held)
            assert 0.0 <= info[keys.MAP_SCALE] <= 1.0
            assert not info.get("cost_substep", 0.0)
            if info[keys.MAP_ANCHOR]:
                assert not info[keys.CBF_INTERVENED] and not info[keys.CBF_REFUSED].any()
                np.testing.assert_array_equal(info[keys.EXECUTED_ACTION], info[keys.PROPOSED_ACTION])
            if info[keys.MAP_SCALE] == 1.0:
                np.testing.assert_array_equal(info[keys.PROPOSED_ACTION], held)
                unchanged += 1
            scaled += info[keys.MAP_SCALE] < 1.0
    assert scaled > 20 and unchanged > 20


@pytest.mark.parametrize(("task", "anchor"), [(POINT, "centre"), (POINT, retreat), (ARM, "backup")])
def test_actions_on_a_ray_are_executed_in_their_order(task, anchor):
    env = sw.SafeActionMap(sw.protect(gym.make(task, max_episode_steps=250)), anchor)
    rng = np.random.default_rng(1)
    compared = 0
    for seed in range(3):
        env.reset(seed=seed)
        over = False
        while not over:
            # Beyond the acting range all forces are the same.
            action = np.clip(seeking(env, rng), *env.get_wrapper_attr("plant").acting_range)
            action = action.astype(np.float32)
            middle, scale, anchored = env.mapped(action)
            if anchored and 0.05 < scale < 0.95:
                # The anchor is on the line through both: action - middle = (1 - scale) (action - anchor).
                start = action - (action - np.asarray(middle, float)) / (1.0 - scale)
                parts = [start + t * (action - start) for t in (0.2, 0.5, 0.8, 1.0)]
                far = [np.linalg.norm(env.mapped(part.astype(np.float32))[0] - start) for part in parts]
                assert (np.diff(far) > 0.0).all()
                compared += 1
            over = env.step(action)[3]
    assert compared > 20


def test_in_closed_form_on_a_cart():
    env = sw.SafeActionMap(limited(), push_back)
    speed = env.reset(seed=0)[0][1]
    rng = np.random.default_rng(0)
    scaled = 0
    for action in rng.uniform(-0.6, 1.0, (200, 1)).astype(np.float32):
        # The filter admits pushes up to the one that reaches the limit; the anchor is -0.5.
        most = (LIMIT - speed) / DT
        share = min(1.0, (most + 0.5) / 1.5) if action[0] > -0.5 else 1.0
        observation, *_, info = env.step(action)
        expected = -0.5 + share * (float(action[0]) + 0.5)
        assert float(env.unwrapped.given[-1][0]) == pytest.approx(expected, abs=0.004)
        assert info[keys.MAP_SCALE] == pytest.approx(share, abs=0.003) and info[keys.MAP_ANCHOR]
        assert not info[keys.CBF_INTERVENED]
        scaled += share < 1.0
        speed = observation[1]
    assert 50 < scaled < 200


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_where_everything_is_admitted_the_action_itself_is_executed(dtype):
    plain, mapped = limited(1e6, dtype), sw.SafeActionMap(limited(1e6, dtype), push_back)
    rng = np.random.default_rng(0)
    plain.reset(seed=0), mapped.reset(seed=0)
    for action in rng.uniform(-1.0, 1.0, (50, 1)).astype(dtype):
        one, two = plain.step(action), mapped.step(action)
        assert one[0].tobytes() == two[0].tobytes()
        assert mapped.unwrapped.given[-1] is action
        assert (two[4].pop(keys.MAP_SCALE), two[4].pop(keys.MAP_ANCHOR)) == (1.0, True)
        assert str(one[4]) == str(two[4])


@pytest.mark.parametrize("anchor", [lambda env: [1.0], lambda env: None])
def test_without_an_admitted_anchor_the_filter_gets_the_action_and_info_tells_it(anchor):
    plain, mapped = limited(), sw.SafeActionMap(limited(), anchor)
    plain.reset(seed=0), mapped.reset(seed=0)
    for _ in range(10):
        *_, one = plain.step(np.ones(1, np.float32))
        *_, two = mapped.step(np.ones(1, np.float32))
        np.testing.assert_array_equal(one[keys.EXECUTED_ACTION], two[keys.EXECUTED_ACTION])
    assert two[keys.CBF_INTERVENED] and two[keys.MAP_SCALE] == 1.0 and two[keys.MAP_ANCHOR] is False


def test_actions_beyond_what_the_drive_can_do_are_mapped_as_its_most():
    env = sw.SafeActionMap(sw.protect(gym.make(POINT)))
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    scaled = 0
    for _ in range(400):
        low, high = env.get_wrapper_attr("plant").acting_range
        assert high[0] < 0.1  # of a box of 1: the rest does nothing
        action = seeking(env, rng)
        sent, scale, _ = env.mapped(action)
        if scale < 1.0:
            scaled += 1
            np.testing.assert_array_equal(sent, env.mapped(np.clip(action, low, high))[0])
            assert (sent >= low - 1e-6).all() and (sent <= high + 1e-6).all()
        env.step(action)
    assert scaled > 20


def test_at_a_hazard_the_centre_leaves_actions_to_choose_from_where_the_backup_leaves_none():
    # The backup is on the edge of what is admitted there: rays that drive on end where they begin.
    left = {}
    for anchor in ("centre", "backup"):
        env = sw.SafeActionMap(sw.protect(gym.make(POINT)), anchor)
        env.reset(seed=0, options={"layout": {"agent": [0.0, 0.0, 0.0], "goal": [1.8, 0.0],
                                              "hazards": [[0.6, 0.02]], "vases": []}})  # fmt: skip
        for _ in range(150):
            env.step(np.array([1.0, 0.0], np.float32))
        ways = [np.array([1.0, turn], np.float32) for turn in np.linspace(-1.0, 1.0, 21)]
        left[anchor] = np.ptp([env.mapped(way)[0] for way in ways], axis=0)[1]
    assert left["centre"] > 0.2 and left["backup"] < 0.05


def test_closest_is_the_filter_but_for_answers_inside_of_what_is_admitted():
    plain, mapped = limited(), sw.SafeActionMap(limited(), "closest")
    plain.reset(seed=0), mapped.reset(seed=0)
    changed = 0
    for action in np.random.default_rng(0).uniform(-0.2, 1.0, (60, 1)).astype(np.float32):
        *_, one = plain.step(action)
        *_, two = mapped.step(action)
        np.testing.assert_allclose(one[keys.EXECUTED_ACTION], two[keys.EXECUTED_ACTION], atol=0.002)
        changed += one[keys.CBF_INTERVENED]
        if not one[keys.CBF_INTERVENED]:
            assert two[keys.MAP_SCALE] == 1.0
    assert 5 < changed < 55


def test_closest_spreads_refused_actions_on_a_detour():
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [1.8, 0.0], "hazards": [[0.6, 0.02]], "vases": []}
    env = sw.SafeActionMap(sw.protect(gym.make(POINT)), "closest")
    env.reset(seed=0, options={"layout": layout})
    spread = []
    for _ in range(60):
        sent = [env.mapped(np.array([1.0, turn], np.float32)) for turn in (-0.2, -0.1, 0.0)]
        if all(0.0 < scale < 1.0 for _, scale, _ in sent):
            spread.append(len({control.tobytes() for control, _, _ in sent}))
        env.step(np.array([1.0, 0.0], np.float32))
    assert spread and max(spread) == 3


def test_an_action_outside_of_the_box_is_mapped_from_its_edge():
    env = sw.SafeActionMap(limited(), push_back)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="left the action space"):
        *_, info = env.step(np.array([3.0], np.float32))  # nothing to map yet: the filter says what it boxed
    assert info[keys.CBF_CLIPPED] == 2.0 and info[keys.MAP_SCALE] == 1.0
    for _ in range(5):
        env.step(np.array([3.0], np.float32))
    sent, scale, _ = env.mapped(np.array([3.0], np.float32))
    np.testing.assert_array_equal(sent, env.mapped(np.ones(1, np.float32))[0])
    assert scale < 1.0


def test_what_is_not_finite_goes_to_the_filter():
    env = sw.SafeActionMap(limited(), push_back)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="not finite"):
        *_, info = env.step(np.array([np.nan], np.float32))
    assert info[keys.CBF_NONFINITE] and info[keys.MAP_ANCHOR] is False and info[keys.MAP_SCALE] == 1.0
    env.unwrapped.state[:] = np.nan
    with warnings.catch_warnings(action="ignore"):
        *_, info = env.step(np.array([1.0], np.float32))
    assert info[keys.CBF_UNSAFE] and info[keys.CBF_FALLBACK] and info[keys.MAP_ANCHOR] is False


def test_the_state_is_observed_once_for_both_and_anew_at_every_step():
    plain, mapped = limited(), sw.SafeActionMap(limited(), push_back)
    for env in (plain, mapped):
        env.reset(seed=0)
        before = env.get_wrapper_attr("plant").observation_id
        for _ in range(5):
            env.step(np.ones(1, np.float32))
        assert env.get_wrapper_attr("plant").observation_id == before + 5
        env.mapped(np.ones(1, np.float32)) if env is mapped else None
        env.reset(seed=0, options={"state": [0.0, LIMIT]})  # another state than the one that was asked about
        *_, info = env.step(np.array([0.3], np.float32))
        assert info[keys.EXECUTED_ACTION][0] <= 1e-6


class Twice(gym.ActionWrapper):
    def action(self, action):
        return 2.0 * action


class Endless(Cart):
    def __init__(self):
        super().__init__()
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)


@pytest.mark.parametrize(
    ("build", "kind", "message"),
    [
        (lambda: sw.SafeActionMap(Cart()), ConfigurationError, "needs a CBFActionFilter inside"),
        (
            lambda: sw.SafeActionMap(Twice(limited()), push_back),
            ConfigurationError,
            r"outside: Twice\(SafeActionMap\(env",
        ),
        (
            lambda: sw.SafeActionMap(
                sw.CBFActionFilter(Endless(), [SpeedRow(1.0)], plant=cart_plant()), push_back
            ),
            ConfigurationError,
            "finite bounds",
        ),
        (lambda: sw.SafeActionMap(limited(), "brake"), UnknownNameError, "no anchor 'brake'; choose centre,"),
        (lambda: sw.SafeActionMap(limited(), "backup"), ConfigurationError, "knows a backup control"),
        (
            lambda: sw.SafeActionMap(sw.SafeActionMap(limited(), push_back), push_back),
            ConfigurationError,
            "mapped already",
        ),
    ],
)
def test_what_it_refuses(build, kind, message):
    with pytest.raises(kind, match=message):
        build()


@pytest.mark.parametrize(
    ("anchor", "message"),
    [
        (lambda env: [0.0, 0.0], r"an action of shape \(1,\), or None"),
        (lambda env: [np.nan], "the anchor must be finite"),
        (lambda env: "left", "the anchor is a number or an array"),
    ],
)
def test_an_anchor_that_is_no_action_is_refused_when_it_comes(anchor, message):
    env = sw.SafeActionMap(limited(), anchor)
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match=message):
        env.step(np.zeros(1, np.float32))


def test_a_wrong_shape_is_refused_before_the_step():
    env = sw.SafeActionMap(limited(), push_back)
    env.reset(seed=0)
    with pytest.raises(ActionError, match="expected an action of shape"):
        env.step(np.zeros(2, np.float32))
    assert env.unwrapped.given == []
