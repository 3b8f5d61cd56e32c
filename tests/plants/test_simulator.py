"""The simulation of an env: equal to the env bit for bit, without a trace in it, or refused."""

import os
import random

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation, RecordEpisodeStatistics, TimeLimit
from simulated_worlds import Cart, NoisyCart, SharedCart, SharedSight, WaitingCart

import safe_wrappers as sw
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.copies import EnvCopier, Simulation

FULL = np.ones(1)
ENVS = ("Pendulum-v1", "CartPole-v1", "FrozenLake-v1", "SafePointGoal1-v0", "Humanoid-v5")
ROBOTICS = ("PointMaze_UMaze-v3", "FetchPush-v4")
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="no child processes here")


def bound(env, **options):
    plant = sw.SimulatorPlant(**options)
    plant.bind(env)
    env.reset(seed=0)
    return plant


def bits(answer):
    observation = answer[0]
    if isinstance(observation, dict):
        observation = np.concatenate([observation[key] for key in sorted(observation)])
    return (np.asarray(observation).tobytes(), *answer[1:4])


@pytest.mark.parametrize("env_id", [*ENVS, *ROBOTICS])
def test_a_rollout_is_what_the_env_does_and_leaves_no_trace_in_it(env_id):
    if env_id in ROBOTICS:
        gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    watched, bare = gym.make(env_id), gym.make(env_id)
    plant = bound(watched, check_steps=50)
    bare.action_space.seed(1)
    over = True
    for _ in range(10):
        if over:
            for env in (watched, bare):
                env.reset(seed=3)
            plant.executed(None)
        action = bare.action_space.sample()
        ahead = plant.rollout(np.atleast_1d(np.asarray(action, dtype=float)), 4)
        for observation, reward in zip(ahead.observations, ahead.rewards, strict=True):
            theirs, own = bits(watched.step(action)), bits(bare.step(action))
            assert theirs == own and bits((observation, reward)) == own[:2]
        over = own[2] or own[3]
        assert ahead.ended == over and (over or ahead.holds == 4)


def test_a_rollout_goes_through_the_wrappers_inside_and_changes_none_of_them():
    env = NormalizeObservation(RecordEpisodeStatistics(TimeLimit(Cart(), 5)))
    plant = bound(env)
    before = env.obs_rms.mean.copy(), env.obs_rms.count
    assert 1000 <= plant.checked_steps < 1010  # at binding, to the end of a stretch
    ahead = plant.rollout(FULL, 9)
    assert len(ahead.observations) == 5 and ahead.ended  # the time limit ends the episode
    assert (env.obs_rms.mean == before[0]).all() and env.obs_rms.count == before[1]
    np.testing.assert_array_equal(ahead.observations, [env.step(FULL)[0] for _ in range(5)])


def test_a_filter_inside_is_copied_with_a_lock_of_its_own():
    env = sw.protect(gym.make("SafePointGoal1-v0", render_mode="rgb_array"))
    env.reset(seed=0)
    copied = EnvCopier(env).copy()
    assert (copied.unwrapped.render_mode, env.unwrapped.render_mode) == (None, "rgb_array")  # nor is it drawn
    theirs, own = (one.step(np.ones(2)) for one in (copied, env))
    assert bits(theirs[:2]) == bits(own[:2])


def test_a_policy_acts_after_the_control_and_measures_stop_a_rollout():
    plant, real = bound(Cart(start=(0.0, 1.0))), Cart(start=(0.0, 1.0))
    asked = []

    def damping(view):
        asked.append(view.observation[1])
        return -view.observation[1:]

    ahead = plant.rollout(FULL, 30, policy=damping)
    assert len(asked) == len(ahead.observations) - 1 == 29  # not after the last step
    real.reset(seed=0)
    action = FULL
    for observation in ahead.observations:
        np.testing.assert_array_equal(observation, real.step(action)[0])
        action = -observation[1:]
    measured = plant.rollout(FULL, 30, measure=lambda view: 0.15 - view.env.x, least=0.0)
    assert measured.values[-1] < 0.0 <= measured.values[-2] and measured.first == measured.values[0]
    unknown = plant.rollout(FULL, 30, measure=lambda view: np.nan if view.env.x > 0.15 else 1.0)
    assert len(unknown.values) == 2 and np.isnan(unknown.values[-1])
    reached = plant.rollout(FULL, 30, until=lambda view: view.observation[0] > 0.5)
    assert reached.reached and not reached.ended and len(reached.observations) < 10


class Reused(Cart):
    """Returns the same array at every step."""

    seen = np.zeros(2)

    def step(self, action):
        self.seen[:], *rest = super().step(action)
        return (self.seen, *rest)


def test_the_first_observation_is_kept_when_the_env_overwrites_it():
    plant = bound(Reused(start=(0.0, 1.0)), check_steps=0)
    first = plant.rollout(FULL, 1).observations[0].copy()
    np.testing.assert_array_equal(plant.rollout(FULL, 5).observations[0], first)


# What is refused --------------------------------------------------------------------------------------------------


class Client:
    """Closes a connection when it is deleted."""

    closed = 0

    def __del__(self):
        Client.closed += 1


def connected():
    env = Cart()
    env.robots = {"left": [Client()]}
    return env


def refers_to_itself():
    env = Cart()
    step = env.step
    env.step = lambda action: step(action)
    return env


class Rewards(gym.Wrapper):
    """Rewards as an array."""

    def __init__(self, env, count):
        super().__init__(env)
        self.count = count

    def step(self, action):
        observation, _, *rest = self.env.step(action)
        return observation, np.arange(self.count, dtype=np.float64), *rest


REFUSED = {
    WaitingCart: r"WaitingCart\.waiting is a generator.*'fork'",
    connected: r"Cart\.robots\['left'\]\[0\] is a Client, which closes",
    refers_to_itself: r"the function Cart\.step refers to the env itself",
    SharedCart: r"SharedCart.*step 1 after.*its reward is .* instead of",
    SharedSight: r"its observation\[0\] is .* instead of",
    lambda: Rewards(Cart(), 2): "wrapper inside that makes one number",
}


@pytest.mark.parametrize(("build", "says"), REFUSED.items(), ids=range(len(REFUSED)))
def test_what_cannot_be_copied_or_is_another_in_a_copy_is_refused_by_name(build, says):
    env, before = build(), Client.closed
    with pytest.raises(UnsupportedEnvError, match=says):
        bound(env)
    assert Client.closed == before


def test_the_ways_out_that_refusals_name_work():
    bound(SharedCart(), check_steps=0)
    bound(gym.wrappers.TransformReward(Rewards(Cart(), 2), np.sum))
    bound(Rewards(Cart(), 1))


@forks
def test_a_child_process_simulates_its_errors_come_back_and_its_end_is_noticed():
    env = WaitingCart()
    plant = bound(env, snapshot="fork", check_steps=5)
    env.step(FULL)
    before = env.x, env.v
    ahead = plant.rollout(FULL, 3)
    assert (env.x, env.v) == before
    np.testing.assert_array_equal(ahead.observations[0], env.step(FULL)[0])
    simulation = Simulation(env, "fork")
    with pytest.raises(ZeroDivisionError):
        simulation.run(lambda other: 1 / 0)
    with pytest.raises(UnsupportedEnvError, match="ended the process"):
        simulation.run(lambda other: os._exit(1))
    assert simulation.run(lambda other: np.zeros(10**6)).size == 10**6  # more than a pipe holds


# Noise ------------------------------------------------------------------------------------------------------------


class Held:
    """Keeps a generator where only what it holds leads to it."""

    __slots__ = ("draw",)

    def __init__(self, generator):
        self.draw = {"generator": generator}


class NoisyActions(gym.Wrapper):
    """Noise from a generator of its own, behind an object with slots."""

    def __init__(self, env, generator):
        super().__init__(env)
        self.held = [Held(generator)]

    def step(self, action):
        generator = self.held[0].draw["generator"]
        normal = generator.gauss if isinstance(generator, random.Random) else generator.normal
        return self.env.step(np.asarray(action) * 0.5 + 0.2 * normal(0.0, 1.0))


NOISY = {
    "the env's own": NoisyCart,
    "NumPy's": lambda: NoisyActions(Cart(), np.random.default_rng(7)),
    "RandomState": lambda: NoisyActions(Cart(), np.random.RandomState(7)),
    "random": lambda: NoisyActions(Cart(), random.Random(7)),
    "np_random of a space": lambda: NoisyActions(Cart(), gym.spaces.Box(-1.0, 1.0, seed=7).np_random),
}


@pytest.mark.parametrize("kind", NOISY)
def test_noise_of_any_generator_is_foreseen(kind):
    watched, bare = NOISY[kind](), NOISY[kind]()
    plant = bound(watched, check_steps=0)
    bare.reset(seed=0)
    for _ in range(2):  # both of a pair of Gaussian numbers
        ahead = [plant.rollout(FULL, 1).observations[0].tobytes() for _ in range(2)]
        real, expected = (env.step(FULL)[0].tobytes() for env in (watched, bare))
        assert ahead == [real, real] and real == expected  # the env itself draws on as it would


class LateNoise(Cart):
    """What is seen, or else measured, draws from the whole process's generator, but not before its hundredth step."""

    made, hidden = 0, 1.0

    def __init__(self, seen):
        super().__init__()
        self.seen = seen

    def step(self, action):
        self.made += 1
        late = 0.1 * np.random.randn() if self.made > 100 else 0.0
        self.hidden = 1.0 + (not self.seen) * late
        return super().step(np.asarray(action) + self.seen * late)


@pytest.mark.parametrize(("seen", "says"), [(True, r"observation\[\d\]"), (False, "h")])
def test_what_is_another_after_the_check_is_flagged_at_its_first_step(seen, says):
    shield = sw.constraints.PredictiveShield(
        lambda view: view.env.hidden, 3, sees="view", terminal=lambda view: True
    )
    env = sw.CBFActionFilter(LateNoise(seen), [shield], plant=sw.SimulatorPlant(check_steps=50))
    env.reset(seed=0)
    for step in range(100):
        info = env.step(np.array([0.1]))[4]
        assert not info["cbf/mismatch"] and env.constraints[0].promise == "proved", step
    with pytest.warns(UserWarning, match=rf"not its simulation's: its {says} is .* instead of") as said:
        assert all(env.step(np.array([0.1]))[4]["cbf/mismatch"] for _ in range(2))
    assert len(said) == 1 and env.constraints[0].promise == "best effort"
