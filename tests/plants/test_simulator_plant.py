"""The simulation of an env: equal to the env bit for bit, without a trace in it, or refused."""

import os
import random
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation, RecordEpisodeStatistics, TimeLimit
from simulated_worlds import (
    Cart,
    NoisyCart,
    SharedCart,
    SharedSight,
    WaitingCart,
)

import safe_wrappers as sw
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.copies import EnvCopier, Simulation

ENVS = ("Pendulum-v1", "CartPole-v1", "FrozenLake-v1", "HalfCheetah-v5", "SafePointGoal1-v0", "Humanoid-v5")
ROBOTICS = ("PointMaze_UMaze-v3", "FetchPush-v4")


def bound(env, **options):
    plant = sw.SimulatorPlant(**options)
    plant.bind(env)
    return plant


def made(env_id):
    if env_id in ROBOTICS:
        gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    return gym.make(env_id)


def bits(answer):
    observation = answer[0]
    if isinstance(observation, dict):
        observation = np.concatenate([observation[key] for key in sorted(observation)])
    return (np.asarray(observation).tobytes(), *answer[1:4])


@pytest.mark.parametrize("env_id", [*ENVS, *ROBOTICS])
def test_a_rollout_is_what_the_env_does_and_leaves_no_trace_in_it(env_id):
    watched, bare = made(env_id), made(env_id)
    plant = bound(watched, check_steps=100)
    for env in (watched, bare):
        env.action_space.seed(1)
        env.reset(seed=3)
    plant.executed(None)
    for _ in range(12):
        action = bare.action_space.sample()
        control = np.atleast_1d(np.asarray(action, dtype=float))
        ahead = plant.rollout(control, 4)
        answers = []
        for step in range(4):
            theirs = watched.step(action)
            answers.append(bare.step(action))
            assert bits(theirs) == bits(answers[-1])
            assert bits((ahead.observations[step], ahead.rewards[step]))[:2] == bits(answers[-1])[:2]
            if answers[-1][2] or answers[-1][3]:
                break
        assert ahead.ended == (answers[-1][2] or answers[-1][3])
        assert len(ahead.observations) == len(answers)
        if ahead.ended:
            for env in (watched, bare):
                env.reset()
            plant.executed(None)


def test_a_rollout_goes_through_the_wrappers_inside_and_changes_none_of_them():
    env = NormalizeObservation(RecordEpisodeStatistics(TimeLimit(Cart(), 5)))
    plant = bound(env)
    env.reset(seed=0)
    before = env.obs_rms.mean.copy(), env.obs_rms.count
    ahead = plant.rollout(np.ones(1), 9)
    assert len(ahead.observations) == 5 and ahead.ended  # the time limit ends the episode
    assert (env.obs_rms.mean == before[0]).all() and env.obs_rms.count == before[1]
    mine = [env.step(np.ones(1))[0] for _ in range(5)]
    np.testing.assert_array_equal(np.array(ahead.observations), np.array(mine))


def test_a_filter_inside_is_copied_with_a_lock_of_its_own():
    env = sw.protect(gym.make("SafePointGoal1-v0"))
    env.reset(seed=0)
    copied = EnvCopier(env).copy()
    theirs, own = (one.step(np.ones(2)) for one in (copied, env))
    assert bits(theirs[:2]) == bits(own[:2])


def test_a_policy_acts_after_the_control_and_measures_stop_a_rollout():
    env = Cart(start=(0.0, 1.0))
    plant = bound(env)
    env.reset(seed=0)
    asked = []

    def policy(view):
        asked.append(view.observation[1])
        return -np.sign(view.observation[1:])

    ahead = plant.rollout(np.ones(1), 30, policy=policy)
    assert len(asked) == len(ahead.observations) - 1 == 29  # not after the last step
    speeds = [o[1] for o in ahead.observations]
    np.testing.assert_allclose(speeds[:3], [1.1, 1.0, 0.9])
    measured = plant.rollout(np.ones(1), 30, measure=lambda view: 0.15 - view.env.x, least=0.0)
    assert measured.values[-1] < 0.0 <= measured.values[-2]
    unknown = plant.rollout(np.ones(1), 30, measure=lambda view: np.nan if view.env.x > 0.15 else 1.0)
    assert len(unknown.values) == 2 and np.isnan(unknown.values[-1])
    damped = plant.rollout(np.ones(1), 6, policy=lambda view: -view.observation[1:]).observations
    real, action = [], np.ones(1)
    other = Cart(start=(0.0, 1.0))
    other.reset(seed=0)
    for _ in range(6):
        real.append(other.step(action)[0])
        action = -real[-1][1:]
    np.testing.assert_array_equal(damped, real)
    reached = plant.rollout(np.ones(1), 30, until=lambda view: view.observation[0] > 0.5)
    assert reached.reached and not reached.ended and len(reached.observations) < 10


class Reused(Cart):
    """Returns the same array at every step."""

    seen = np.zeros(2)

    def step(self, action):
        self.seen[:], *rest = super().step(action)
        return (self.seen, *rest)


def test_the_first_observation_is_kept_when_the_env_overwrites_it():
    env = Reused(start=(0.0, 1.0))
    plant = bound(env, check_steps=0)
    env.reset(seed=0)
    first = plant.rollout(np.ones(1), 1).observations[0].copy()
    np.testing.assert_array_equal(plant.rollout(np.ones(1), 5).observations[0], first)


def test_what_cannot_be_copied_is_refused_by_name_with_a_way_out_that_works():
    with pytest.raises(UnsupportedEnvError, match=r"WaitingCart\.waiting is a generator.*'fork'"):
        bound(WaitingCart())
    if hasattr(os, "fork"):
        env = WaitingCart()
        plant = bound(env, snapshot="fork", check_steps=60)
        env.reset(seed=0)
        env.step(np.ones(1))
        before = env.x, env.v
        ahead = plant.rollout(np.ones(1), 3)
        assert (env.x, env.v) == before
        np.testing.assert_array_equal(ahead.observations[0], env.step(np.ones(1))[0])


def test_what_closes_a_connection_when_it_is_deleted_is_not_copied():
    class Client:
        closed = 0

        def __del__(self):
            Client.closed += 1

    env = Cart()
    env.robots = {"left": [Client()]}
    with pytest.raises(UnsupportedEnvError, match=r"Cart\.robots\['left'\]\[0\] is a Client, which closes"):
        bound(env)
    assert Client.closed == 0


def test_a_function_that_refers_to_the_env_is_refused():
    env = Cart()
    step = env.step
    env.step = lambda action: step(action)
    with pytest.raises(UnsupportedEnvError, match=r"the function Cart\.step refers to the env itself"):
        bound(env)


def test_a_copy_that_drifts_is_refused_with_the_first_difference():
    with pytest.raises(UnsupportedEnvError, match=r"SharedCart.*step 1 after.*its reward is .* instead of"):
        bound(SharedCart())
    with pytest.raises(UnsupportedEnvError, match=r"its observation\[0\] is .* instead of"):
        bound(SharedSight())
    bound(SharedCart(), check_steps=0)


def test_the_noise_of_the_env_is_foreseen():
    env = NoisyCart()
    plant = bound(env)
    env.reset(seed=0)
    ahead = plant.rollout(np.ones(1), 1).observations[0]
    again = plant.rollout(np.ones(1), 1).observations[0]
    assert ahead.tobytes() == again.tobytes() == env.step(np.ones(1))[0].tobytes()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no child processes here")
def test_errors_of_a_child_come_back_and_its_end_is_noticed():
    env = Cart()
    simulation = Simulation(env, "fork")
    env.reset(seed=0)
    with pytest.raises(ZeroDivisionError):
        simulation.run(lambda other: 1 / 0)
    with pytest.raises(UnsupportedEnvError, match="ended the process"):
        simulation.run(lambda other: os._exit(1))
    assert simulation.run(lambda other: np.zeros(10**6)).size == 10**6  # more than a pipe holds


class Held:
    """Keeps a generator where only what it holds leads to it."""

    __slots__ = ("draw",)

    def __init__(self, draw):
        self.draw = draw


def push(held):
    generator = held[0].draw["generator"]
    return generator.gauss(0.0, 1.0) if isinstance(generator, random.Random) else generator.standard_normal()


class OwnNoise(Cart):
    """Noise from a generator of its own, behind an object with slots."""

    def __init__(self, generator):
        super().__init__()
        self.held = [Held({"generator": generator})]

    def step(self, action):
        return super().step(np.asarray(action) * 0.5 + 0.2 * push(self.held))


class NoisyActions(gym.Wrapper):
    """A wrapper with a generator of its own."""

    def __init__(self, env, generator):
        super().__init__(env)
        self.held = [Held({"generator": generator})]

    def step(self, action):
        return self.env.step(np.asarray(action) * 0.5 + 0.2 * push(self.held))


GENERATORS = {
    "NumPy's": np.random.default_rng,
    "RandomState": np.random.RandomState,
    "random": random.Random,
    "np_random of a space": lambda seed: gym.spaces.Box(-1.0, 1.0, seed=seed).np_random,
}


@pytest.mark.parametrize("where", ["env", "wrapper"])
@pytest.mark.parametrize("kind", GENERATORS)
def test_noise_of_any_generator_is_foreseen(kind, where):
    drawn = [GENERATORS[kind](7) for _ in range(2)]
    envs = [OwnNoise(g) if where == "env" else NoisyActions(Cart(), g) for g in drawn]
    plant = bound(envs[0], check_steps=0)
    for env in envs:
        env.reset(seed=0)
    first = envs[0].step(np.ones(1))[0]  # of a pair of Gaussian numbers
    assert first.tobytes() == envs[1].step(np.ones(1))[0].tobytes()
    ahead = [plant.rollout(np.ones(1), 1).observations[0].tobytes() for _ in range(2)]
    real, bare = (env.step(np.ones(1))[0].tobytes() for env in envs)
    assert real == bare, "the env itself draws on as it would"
    assert ahead == [real, real]


class LateNoise(Cart):
    """Draws from the generator of the whole process, but not before its hundredth step."""

    made, seen = 0, "observation"

    def step(self, action):
        self.made += 1
        push = 0.1 * np.random.randn() if self.made > 100 else 0.0
        if self.seen == "observation":
            return super().step(np.asarray(action) + push)
        self.hidden = 1.0 + push
        return super().step(action)


@pytest.mark.parametrize("seen", ["observation", "h alone"])
def test_noise_that_begins_after_the_check_is_flagged_at_its_first_step(seen):
    kind = type("Late", (LateNoise,), {"seen": seen, "hidden": 1.0})
    shield = sw.constraints.PredictiveShield(
        lambda view: view.env.hidden, 3, sees="view", terminal=lambda view: True
    )
    env = sw.CBFActionFilter(kind(), [shield], plant=sw.SimulatorPlant(check_steps=50))
    env.reset(seed=0)
    (own,) = env.constraints
    for step in range(1, 100 + 1):
        info = env.step(np.array([0.1]))[4]
        assert not info["cbf/mismatch"] and own.promise == "proved", step
    with pytest.warns(UserWarning, match=r"not its simulation's: its (observation\[\d\]|h) is .* instead of"):
        assert env.step(np.array([0.1]))[4]["cbf/mismatch"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        assert env.step(np.array([0.1]))[4]["cbf/mismatch"]
    assert env.constraints[0].promise == "best effort"


class Rewards(gym.Wrapper):
    """Rewards as an array."""

    def __init__(self, env, count):
        super().__init__(env)
        self.count = count

    def step(self, action):
        observation, _, *rest = self.env.step(action)
        return observation, np.arange(self.count, dtype=np.float64), *rest


def test_a_vector_of_rewards_is_refused_with_a_way_out_that_works():
    with pytest.raises(UnsupportedEnvError, match="wrapper inside that makes one number"):
        bound(Rewards(Cart(), 2))
    bound(gym.wrappers.TransformReward(Rewards(Cart(), 2), np.sum))
    bound(Rewards(Cart(), 1))
