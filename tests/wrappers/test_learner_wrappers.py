"""Wrappers of a learner: repeated actions, penalties, what the filter shows, rewards of several objectives."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from worlds import Cart, SpeedRow, cart_plant

import safe_wrappers as sw
from safe_wrappers import info as keys

sys.path.append(str(Path(__file__).parents[1] / "plants" / "simulator"))


def stack():
    return sw.RecordInterventions(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=50)))


def test_rewards_and_costs_are_summed_up_and_the_filter_checks_every_control_step():
    repeated, single = sw.ActionRepeat(stack(), 4), stack()
    layout = {"agent": [0, 0, 0], "hazards": [[0.4, 0.02]], "goal": [1.4, 0]}
    for env in (repeated, single):
        env.reset(seed=0, options={"layout": layout})
    changed = 0
    for decision in range(13):
        action = np.array([1.0, 0.0], dtype=np.float32)
        observation, reward, _, truncated, info = repeated.step(action)
        steps = [single.step(action) for _ in range(4 if decision < 12 else 2)]
        np.testing.assert_array_equal(observation, steps[-1][0])
        assert reward == sum(step[1] for step in steps)
        assert info[keys.CBF_INTERVENED] == any(step[4][keys.CBF_INTERVENED] for step in steps)
        assert info[keys.CBF_CORRECTION] == max(step[4][keys.CBF_CORRECTION] for step in steps)
        changed += info[keys.CBF_INTERVENED]
        assert truncated == (decision == 12)
    assert 0 < changed < 13
    assert info[keys.EPISODE_SUMMARY] == steps[-1][4][keys.EPISODE_SUMMARY]
    assert info[keys.EPISODE_SUMMARY]["length"] == 50


LIMIT = 0.25
"""The cart may not be faster; from rest at full throttle it gets there in 2.5 steps of 0.1 s."""


class PaidCart(Cart):
    """A cart that is paid its position, ten times over, less what its push costs."""

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        reward = 10.0 * self.state[0] - float(np.asarray(action)[0]) ** 2
        return observation, reward, terminated, truncated, info


def filtered(env=None):
    return sw.CBFActionFilter(env or PaidCart(), [SpeedRow(LIMIT)], plant=cart_plant())


def drive(env, steps=40, seed=0):
    """Random pushes from rest: each push, the speed before it, and what the step returned."""
    rng = np.random.default_rng(seed)
    speed, seen = env.reset(seed=seed)[0][1], []
    for push in rng.uniform(-0.2, 1.0, (steps, 1)).astype(np.float32):
        step = env.step(push)
        seen.append((push, speed, *step))
        speed = step[0][1]
    return seen


@pytest.mark.parametrize("penalty", [0.5, np.float32(3)])
def test_a_changed_step_costs_the_penalty_and_no_other_does(penalty):
    penalised, plain = drive(sw.AdaptionPenalty(filtered(), penalty)), drive(filtered())
    changed = 0
    for (push, speed, observation, reward, *_, info), (_, _, same, task, *_) in zip(
        penalised, plain, strict=True
    ):
        # The filter in closed form: no push above the one that reaches the limit within this step.
        correction = float(push[0]) - min(float(push[0]), (LIMIT - speed) / 0.1)
        changed += correction > 0
        assert info[keys.ADAPTION_PENALTY] == (penalty if correction > 0 else 0.0)
        assert reward == task - info[keys.ADAPTION_PENALTY]
        assert type(info[keys.ADAPTION_PENALTY]) is float
        np.testing.assert_array_equal(observation, same)
    assert 5 < changed < 35


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_non_finite_action_costs_the_penalty(value):
    env = sw.AdaptionPenalty(filtered(), penalty=0.5)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="not finite"):
        _, reward, _, _, info = env.step(np.array([value], np.float32))
    assert info[keys.CBF_INTERVENED] and info[keys.CBF_NONFINITE]
    assert info[keys.ADAPTION_PENALTY] == 0.5
    assert np.isfinite(reward)


LOOKED_AT = ("SafePointGoal1-v0", "SafeCarGoal2-v0", "InvertedPendulum-v5", "Reacher-v5", "HalfCheetah-v5")


def features_of(env, observation):
    return np.asarray(observation[env.env.observation_space.shape[0] :])


def expected_discs(env, count):
    """The nearest hazards in the robot's frame by complex numbers, from what the env publishes."""
    task = env.unwrapped
    heading = np.exp(1j * task.agent_heading)
    centres = task.hazard_positions @ [1, 1j]
    offsets = (centres - task.agent_position @ [1, 1j]) / heading
    velocity = (task.data.qvel[0] + 1j * task.data.qvel[1]) / heading
    rows = []
    for offset in offsets[np.argsort(np.abs(offsets))][:count]:
        way = offset / abs(offset)
        clearance = abs(offset) - task.hazard_radius - 0.004  # the recipe's margin
        closing = (velocity * way.conjugate()).real
        rows.append([way.real, way.imag, clearance / (1 + abs(clearance)), closing / (1 + abs(closing))])
    return np.array(rows)


def test_of_hazards_the_nearest_are_shown_in_the_robots_frame():
    env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")), neighbours=3)
    observation, _ = env.reset(seed=4)
    env.action_space.seed(4)
    for _ in range(200):
        shown = features_of(env, observation)
        np.testing.assert_allclose(shown[2:14].reshape(3, 4), expected_discs(env, 3), atol=1e-6)
        action = env.action_space.sample()
        observation, _, _, _, info = env.step(action)
        share = (info[keys.EXECUTED_ACTION] - info[keys.PROPOSED_ACTION]) / 2.0
        np.testing.assert_allclose(features_of(env, observation)[-2:], share, atol=1e-7)


def test_a_detour_is_shown_with_the_time_that_is_left_of_it():
    env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")))
    layout = {"agent": [0, 0, 0], "hazards": [[0.6, 0.02]], "goal": [1.4, 0]}
    observation, _ = env.reset(seed=0, options={"layout": layout})
    shown = [features_of(env, observation)[1]]
    for _ in range(60):
        observation = env.step(np.array([1.0, 0.0], dtype=np.float32))[0]
        shown.append(features_of(env, observation)[1])
    began = next(i for i, side in enumerate(shown) if side)
    assert shown[:began] == [0.0] * began
    assert shown[began] == pytest.approx(-49 / 50, abs=1e-6)  # to the right of a disc that is on the left


@pytest.mark.parametrize("acts", [True, False])
@pytest.mark.parametrize("name", LOOKED_AT)
def test_bounded_of_one_shape_and_without_any_effect(name, acts):
    """Beside the same env without the wrapper: the same actions are executed, with the same results."""
    plain, seen = gym.make(name), gym.make(name)
    constraints = sw.protect(gym.make(name)).constraints
    if acts:
        plain = sw.protect(plain)
        seen = sw.FilterObservation(sw.protect(seen))
    else:
        seen = sw.FilterObservation(seen, constraints)
    observation, _ = seen.reset(seed=3)
    plain.reset(seed=3)
    seen.action_space.seed(3)
    for _ in range(60):
        assert seen.observation_space.contains(observation)
        assert (np.abs(features_of(seen, observation)) <= 1.0).all()
        action = seen.action_space.sample()
        observation, reward, terminated, truncated, info = seen.step(action)
        same, same_reward, *_, same_info = plain.step(action)
        np.testing.assert_array_equal(observation[: len(same)], same.astype(observation.dtype))
        assert reward == same_reward
        if acts:
            np.testing.assert_array_equal(info[keys.EXECUTED_ACTION], same_info[keys.EXECUTED_ACTION])
        if terminated or truncated:
            observation, _ = seen.reset(seed=5)
            plain.reset(seed=5)


def test_an_unfiltered_learner_sees_what_the_filtered_one_sees():
    acting = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")))
    watching = sw.FilterObservation(gym.make("SafePointGoal1-v0"), acting.get_wrapper_attr("constraints"))
    one, other = acting.reset(seed=1)[0], watching.reset(seed=1)[0]
    steps = 0
    while True:
        np.testing.assert_array_equal(one, other)
        action = np.array([1.0, 0.3], dtype=np.float32)
        one, *_, info = acting.step(action)
        other = watching.step(action)[0]
        if info[keys.CBF_INTERVENED]:
            break
        steps += 1
    assert steps > 10


def test_the_room_of_a_clearance():
    walls = [sw.constraints.Plane([-0.9], [1.0]), sw.constraints.Plane([0.9], [-1.0])]
    limit = sw.constraints.Clearance(walls, bodies=["cart"], braking=8.0)
    env = sw.FilterObservation(gym.make("InvertedPendulum-v5"), [limit])
    observation, _ = env.reset(seed=0)
    for _ in range(8):
        clearance = 0.9 - abs(env.unwrapped.data.qpos[0])
        shown = features_of(env, observation)
        assert shown[0] <= clearance / (1 + clearance) + 1e-6
        observation = env.step(np.array([3.0], dtype=np.float32))[0]


class Pictured(gym.ObservationWrapper):
    """An observation of another kind."""

    def __init__(self, env, space, make):
        super().__init__(env)
        self.observation_space, self.observation = space, make


@pytest.mark.parametrize("key", ["pixels", None])
def test_dicts_get_a_key_and_images_become_dicts(key):
    image = gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)
    space = image if key is None else gym.spaces.Dict({key: image})
    picture = np.zeros((4, 4, 3), np.uint8)
    task = Pictured(Cart(), space, lambda _: picture if key is None else {key: picture})
    env = sw.FilterObservation(sw.CBFActionFilter(task, [SpeedRow(0.25)], plant=cart_plant()))
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert set(observation) == {key or "observation", "filter"}
    assert observation["filter"].dtype == np.float32


def test_what_was_not_judged_is_not_a_number():
    env = sw.FilterObservation(sw.protect(gym.make("Reacher-v5")))
    env.reset(seed=0)
    env.unwrapped.data.qvel[:] = np.nan
    observer = env.get_wrapper_attr("filter")
    observer.observe()
    shown = env._with_features(np.zeros(10), np.zeros(2))[10:]
    assert np.isnan(shown[0])
    assert shown[1:].tolist() == [0.0, 0.0]
