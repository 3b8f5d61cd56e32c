"""What FilterObservation shows, against the env's own truth; and that looking changes nothing."""

import gymnasium as gym
import numpy as np
import pytest
from worlds import Cart, SpeedRow, cart_plant

import safe_wrappers as sw
from safe_wrappers import info as keys

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


def test_the_room_of_a_clearance_and_its_nearest_surfaces():
    walls = [sw.constraints.Plane([-0.9], [1.0]), sw.constraints.Plane([0.9], [-1.0])]
    limit = sw.constraints.Clearance(walls, bodies=["cart"], braking=8.0)
    env = sw.FilterObservation(gym.make("InvertedPendulum-v5"), [limit], neighbours=1)
    observation, _ = env.reset(seed=0)
    for _ in range(8):
        place, speed = env.unwrapped.data.qpos[0], env.unwrapped.data.qvel[0]
        clearance, away = 0.9 - abs(place), -np.sign(place)
        shown = features_of(env, observation)
        assert shown[0] <= clearance / (1 + clearance) + 1e-6
        wanted = [away, 0, 0, clearance / (1 + clearance), -away * speed / (1 + abs(speed))]
        np.testing.assert_allclose(shown[1:6], wanted, atol=1e-6)
        observation = env.step(np.array([3.0], dtype=np.float32))[0]


class Pictured(gym.ObservationWrapper):
    """An observation of another kind."""

    def __init__(self, env, space, make):
        super().__init__(env)
        self.observation_space, self.observation = space, make


def test_of_wheels_the_slip_in_shares_of_the_limit_and_the_ground_as_estimated():
    env = sw.FilterObservation(sw.protect(gym.make("SafeRover-v0")))
    observation, _ = env.reset(seed=0)
    (bound,) = env.env.filter.bound
    assert features_of(env, observation).shape == (8 + 5,)
    limited = 0
    for step in range(60):
        action = np.append(np.full(4, 1.0 if step % 20 < 12 else -1.0), 0.1).astype(np.float32)
        observation, _, _, _, info = env.step(action)
        shown = features_of(env, observation)
        slip = info["slip"]  # the env's own, at the end of the step
        clear = np.abs(slip) > 0.01
        np.testing.assert_array_equal(np.sign(shown[:4])[clear], np.sign(slip)[clear])
        # The limit in force is max_slip or less, but never below a tenth of it.
        least = np.minimum(np.abs(slip) / bound.spec.max_slip, 1.0)
        assert (np.abs(shown[:4]) >= least - 1e-3).all() and (np.abs(shown[:4]) <= 10.0 * least + 1e-2).all()
        limited += np.abs(shown[:4]).max() > 0.9
        mu = bound.seen.estimate.mean
        np.testing.assert_allclose(shown[4:8], mu / (1.0 + mu), atol=1e-7)
    assert limited > 5


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


def test_refused():
    env = gym.make("SafePointGoal1-v0")
    limit = sw.protect(gym.make("SafePointGoal1-v0")).constraints
    with pytest.raises(sw.SafeWrappersError, match="needs a filter inside or constraints"):
        sw.FilterObservation(env)
    with pytest.raises(sw.SafeWrappersError, match="leave constraints and plant out"):
        sw.FilterObservation(sw.protect(env), limit)
    with pytest.raises(sw.SafeWrappersError, match="shows what the filter decides by already"):
        sw.FilterObservation(sw.FilterObservation(sw.protect(env)))
    with pytest.raises(sw.SafeWrappersError, match="put it outside"):
        sw.CBFActionFilter(sw.FilterObservation(env, limit), limit)
    with pytest.raises(sw.SafeWrappersError, match="neighbours"):
        sw.FilterObservation(sw.protect(env), neighbours=-1)
    space = gym.spaces.Dict({"filter": gym.spaces.Box(0, 1, (1,))})
    with pytest.raises(sw.SafeWrappersError, match="has a key 'filter' already"):
        sw.FilterObservation(sw.protect(Pictured(env, space, lambda o: o)))
