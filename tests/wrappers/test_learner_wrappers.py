"""Wrappers of a learner: repeated actions, penalties, what the filter shows, and where a policy is stuck."""

import gymnasium as gym
import numpy as np
import pytest
from asking import Below
from episodes import actions
from worlds import Cart, filtered_cart

import safe_wrappers as sw
from safe_wrappers import info as keys

PUSH = np.array([1.0, 0.0], dtype=np.float32)
BEFORE_A_HAZARD = {"layout": {"agent": [0, 0, 0], "hazards": [[0.5, 0.0]], "goal": [1.3, 0.0]}}


# Repeated actions -------------------------------------------------------------------------------------------------


def test_rewards_are_summed_up_and_the_filter_checks_every_control_step():
    def stack():
        env = sw.RecordInterventions(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=50)))
        env.reset(seed=0, options=BEFORE_A_HAZARD)
        return env

    single, repeated, changed = stack(), sw.ActionRepeat(stack(), 4), 0
    for decision in range(13):
        observation, reward, _, truncated, info = repeated.step(PUSH)
        steps = [single.step(PUSH) for _ in range(4 if decision < 12 else 2)]
        np.testing.assert_array_equal(observation, steps[-1][0])
        assert reward == sum(step[1] for step in steps)
        assert info[keys.CBF_INTERVENED] == any(step[4][keys.CBF_INTERVENED] for step in steps)
        assert info[keys.CBF_CORRECTION] == max(step[4][keys.CBF_CORRECTION] for step in steps)
        changed += info[keys.CBF_INTERVENED]
        assert truncated == (decision == 12)
    assert 0 < changed < 13
    assert info[keys.EPISODE_SUMMARY] == steps[-1][4][keys.EPISODE_SUMMARY]
    assert info[keys.EPISODE_SUMMARY]["length"] == 50


# Penalties --------------------------------------------------------------------------------------------------------

LIMIT = 0.25
"""The cart may not be faster; from rest at full throttle it gets there in 2.5 steps of 0.1 s."""


@pytest.mark.parametrize("penalty", [0.5, np.float32(3)])
def test_a_changed_step_costs_the_penalty_and_no_other_does(penalty):
    paid = gym.wrappers.TransformReward(Cart(), lambda _: 1.5)
    env, changed = sw.AdaptionPenalty(filtered_cart([Below(LIMIT, of=1)], env=paid), penalty), 0
    (_, speed), info = env.reset(seed=0)
    assert info[keys.ADAPTION_PENALTY] == 0.0
    for push in np.random.default_rng(0).uniform(-0.2, 1.0, (40, 1)).astype(np.float32):
        # The filter in closed form: no push above the one that reaches the limit within this step.
        correction = float(push[0]) > (LIMIT - speed) / 0.1
        (_, speed), reward, *_, info = env.step(push)
        assert info[keys.ADAPTION_PENALTY] == (penalty if correction else 0.0)
        assert type(info[keys.ADAPTION_PENALTY]) is float and reward == 1.5 - info[keys.ADAPTION_PENALTY]
        changed += correction
    assert 5 < changed < 35


# What the filter shows --------------------------------------------------------------------------------------------


def features_of(env, observation):
    return np.asarray(observation[env.env.observation_space.shape[0] :])


def expected_discs(env, count):
    """The nearest hazards in the robot's frame by complex numbers, from what the env publishes."""
    task = env.unwrapped
    heading = np.exp(1j * task.agent_heading)
    offsets = (task.hazard_positions - task.agent_position) @ [1, 1j] / heading
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
    for _ in range(100):
        shown = features_of(env, observation)
        np.testing.assert_allclose(shown[2:14].reshape(3, 4), expected_discs(env, 3), atol=1e-6)
        observation, _, _, _, info = env.step(env.action_space.sample())
        share = (info[keys.EXECUTED_ACTION] - info[keys.PROPOSED_ACTION]) / 2.0
        np.testing.assert_allclose(features_of(env, observation)[-2:], share, atol=1e-7)
    alone = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")), neighbours=0)
    assert alone.observation_space.shape[0] == env.observation_space.shape[0] - 12


def test_a_detour_is_shown_with_the_time_that_is_left_of_it():
    env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")))
    layout = {"agent": [0, 0, 0], "hazards": [[0.6, 0.02]], "goal": [1.4, 0]}
    observations = [env.reset(seed=0, options={"layout": layout})[0]]
    observations += [env.step(PUSH)[0] for _ in range(60)]
    shown = [features_of(env, observation)[1] for observation in observations]
    began = next(i for i, side in enumerate(shown) if side)
    assert shown[:began] == [0.0] * began
    assert shown[began] == pytest.approx(-49 / 50, abs=1e-6)  # to the right of a disc that is on the left


@pytest.mark.parametrize(
    "name", ["SafePointGoal1-v0", "SafeCarGoal2-v0", "InvertedPendulum-v5", "Reacher-v5", "HalfCheetah-v5"]
)
def test_it_stays_within_its_space_and_changes_nothing(name):
    plain, seen = sw.protect(gym.make(name)), sw.FilterObservation(sw.protect(gym.make(name)))
    plain.reset(seed=3)
    observation = seen.reset(seed=3)[0]
    for action in actions(seen, 60):
        assert seen.observation_space.contains(observation)
        assert (np.abs(features_of(seen, observation)) <= 1.0).all()
        observation, *answer = seen.step(action)
        same, *expected = plain.step(action)
        np.testing.assert_array_equal(observation[: len(same)], same.astype(observation.dtype))
        np.testing.assert_equal(answer, expected)
        if answer[1]:
            break


def test_an_unfiltered_learner_sees_what_the_filtered_one_sees():
    acting = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")))
    watching = sw.FilterObservation(gym.make("SafePointGoal1-v0"), acting.get_wrapper_attr("constraints"))
    one, other = acting.reset(seed=1)[0], watching.reset(seed=1)[0]
    changed, steps = False, 0
    while not changed:
        np.testing.assert_array_equal(one, other)
        action = np.array([1.0, 0.3], dtype=np.float32)
        (one, *_, info), (other, *_) = acting.step(action), watching.step(action)
        changed, steps = info[keys.CBF_INTERVENED], steps + 1
    assert steps > 10


class Pictured(gym.ObservationWrapper):
    """An observation of another kind."""

    def __init__(self, env, space):
        super().__init__(env)
        self.observation_space = space

    def observation(self, observation):
        return self.observation_space.sample()


IMAGE = gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("space", "key"), [(IMAGE, "observation"), (gym.spaces.Dict(pixels=IMAGE), "pixels")]
)
def test_dicts_get_a_key_and_images_become_dicts(space, key):
    env = sw.FilterObservation(filtered_cart([Below(LIMIT, of=1)], env=Pictured(Cart(), space)))
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert set(observation) == {key, "filter"} and observation["filter"].dtype == np.float32


class Broken(gym.Wrapper):
    """Its state is no number after a step."""

    def step(self, action):
        answer = self.env.step(action)
        self.unwrapped.data.qvel[:] = np.nan
        return answer


def test_what_was_not_judged_is_not_a_number():
    env = sw.FilterObservation(sw.protect(Broken(gym.make("Reacher-v5"))))
    env.reset(seed=0)
    judged, *correction = features_of(env, env.step(np.zeros(2, np.float32))[0])
    assert np.isnan(judged) and correction == [0.0, 0.0]


# Stuck ------------------------------------------------------------------------------------------------------------


def test_stuck_is_what_its_definition_says_and_nothing_is_changed():
    plain, watched = (sw.protect(gym.make("SafePointGoal1-v0"), detour=False) for _ in range(2))
    watched = sw.StuckMonitor(watched, after_s=1.0, progress=0.05)
    for env in (plain, watched):  # the point robot stands, then pushes against a hazard
        env.reset(seed=0, options=BEFORE_A_HAZARD)
    window, rewards, changed, stuck = 50, [], [], 0
    for k in range(400):
        action = PUSH if k >= 100 else 0.0 * PUSH
        _, reward, _, _, info = watched.step(action)
        rewards.append(reward)
        changed.append(info[keys.CBF_INTERVENED])
        most = k + 1 >= window and sum(changed[-window:]) > window / 2
        assert info[keys.CBF_STUCK] == bool(most and sum(rewards[-window:]) <= 0.05)
        same = plain.step(action)[4]
        assert all(np.array_equal(info[key], same[key]) for key in same)
        stuck += info[keys.CBF_STUCK]
    assert 100 < stuck < 350
