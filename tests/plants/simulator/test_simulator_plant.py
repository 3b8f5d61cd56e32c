"""The simulation of an env: equal to the env bit for bit, without a trace in it, or refused."""

import copy
import os
import random
import time
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.wrappers import NormalizeObservation, RecordEpisodeStatistics, RescaleAction, TimeLimit
from simulated_worlds import (
    DT,
    Cart,
    CloneCart,
    Grid,
    LockedCart,
    NoisyCart,
    PickyCart,
    SharedCart,
    SharedSight,
    StateCart,
)

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.simulator.simulation import simulation_of

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


def test_wrappers_inside_may_change_actions_as_they_are_simulated_too():
    env = RescaleAction(Cart(), -2.0, 2.0)
    plant = bound(env)
    env.reset(seed=0)
    ahead = plant.rollout(np.array([2.0]), 2).observations
    np.testing.assert_array_equal(ahead, [env.step(np.array([2.0]))[0] for _ in range(2)])
    assert ahead[0][1] == 0.1  # of 1 m/s^2


def test_a_policy_acts_after_the_control_and_measures_stop_a_rollout():
    env = Cart(start=(0.0, 1.0))
    plant = bound(env)
    env.reset(seed=0)
    ahead = plant.rollout(np.ones(1), 30, policy=lambda view: -np.sign(view.observation[1:]))
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


def test_a_copy_does_not_go_by_ezpickle():
    env = PickyCart(start=(1.0, 0.0))
    plant = bound(env)
    env.reset(seed=0)
    env.step(np.ones(1))
    assert plant.simulation.run(lambda other: other.v) == env.v != 0.0


def test_a_copy_does_not_draw():
    class Drawn(Cart):
        render_mode = "human"

        def __init__(self):
            super().__init__()
            self.render_mode = "human"

        def step(self, action):
            assert self.render_mode is None, "drawn in a simulation"
            return super().step(action)

    env = Drawn()
    for snapshot in (None, (lambda raw: (raw.x, raw.v), restore_cart)):
        plant = bound(env, snapshot=snapshot, check_steps=0)
        env.reset(seed=0)
        assert len(plant.rollout(np.ones(1), 3).rewards) == 3
        assert env.render_mode == "human"


def restore_cart(raw, state):
    raw.x, raw.v = state


def test_what_cannot_be_copied_is_refused_by_name_with_ways_out_that_work():
    with pytest.raises(UnsupportedEnvError, match=r"LockedCart\.lock is a lock.*save, restore.*'fork'"):
        bound(LockedCart())
    ways = [(lambda raw: (raw.x, raw.v), restore_cart)]
    if hasattr(os, "fork"):
        ways.append("fork")
    for snapshot in ways:
        env = LockedCart()
        plant = bound(env, snapshot=snapshot, check_steps=60)
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
    forgets = (lambda raw: raw.x, lambda raw, x: setattr(raw, "x", x))  # the speed
    with pytest.raises(UnsupportedEnvError, match=r"its (reward|observation\[\d\]) is .* instead of"):
        bound(Cart(), snapshot=forgets)
    bound(Cart(), snapshot=forgets, check_steps=0)


def test_the_envs_own_functions_are_used():
    StateCart.calls = 0
    bound(StateCart())
    assert StateCart.calls > 0
    bound(CloneCart())
    assert CloneCart.seen is True


def test_wrappers_are_put_back_where_the_env_is_simulated_itself():
    env = TimeLimit(StateCart(), 5)
    plant = bound(env)
    env.reset(seed=0)
    assert plant.rollout(np.ones(1), 9).ended
    assert [env.step(np.ones(1))[3] for _ in range(5)] == [False] * 4 + [True]


def test_a_check_leaves_the_generator_of_an_env_that_is_simulated_itself():
    class NoisyState(StateCart):
        noise = 0.5

    checked, bare = NoisyState(), NoisyState()
    for env in (checked, bare):
        env.reset(seed=5)
    bound(checked)
    for env in (checked, bare):
        env.reset()
    assert checked.step(np.ones(1))[0].tobytes() == bare.step(np.ones(1))[0].tobytes()


def test_the_noise_of_the_env_is_foreseen_unless_told():
    for same_noise in (True, False):
        env = NoisyCart()
        plant = bound(env, same_noise=same_noise)
        env.reset(seed=0)
        ahead = plant.rollout(np.ones(1), 1).observations[0]
        again = plant.rollout(np.ones(1), 1).observations[0]
        assert ahead.tobytes() == again.tobytes()
        assert (ahead.tobytes() == env.step(np.ones(1))[0].tobytes()) == same_noise


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no child processes here")
def test_errors_of_a_child_come_back_and_its_end_is_noticed():
    env = Cart()
    simulation = simulation_of(env, "fork")
    env.reset(seed=0)
    with pytest.raises(ZeroDivisionError):
        simulation.run(lambda other: 1 / 0)
    with pytest.raises(UnsupportedEnvError, match="ended the process"):
        simulation.run(lambda other: os._exit(1))
    assert simulation.run(lambda other: np.zeros(10**6)).size == 10**6  # more than a pipe holds


def test_bad_input_is_refused():
    with pytest.raises(ConfigurationError, match="snapshot is two functions"):
        bound(Cart(), snapshot="copy")
    with pytest.raises(ConfigurationError, match="check_steps"):
        sw.SimulatorPlant(check_steps=-1)
    plant = bound(Cart())
    with pytest.raises(ConfigurationError, match="bound to another env"):
        plant.bind(Cart())
    with pytest.raises(UnsupportedEnvError, match="needs the acceleration"):
        _ = plant.g

    class Recorded(gym.Wrapper):
        pass

    Recorded.__name__ = "RecordVideo"
    with pytest.raises(ConfigurationError, match="RecordVideo inside the filter would also record"):
        bound(Recorded(Cart()))
    endless = Cart()
    endless.action_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    with pytest.raises(UnsupportedEnvError, match="bounded"):
        bound(endless)
    parts = Cart()
    parts.action_space = gym.spaces.Dict(a=gym.spaces.Discrete(2))
    with pytest.raises(UnsupportedEnvError, match="flatten_space"):
        bound(parts)


def test_the_control_interval_is_never_guessed():
    assert bound(Cart()).control_dt == DT
    with pytest.raises(ConfigurationError, match="one step of this env lasts"):
        bound(Cart(), control_dt=0.2)
    with pytest.raises(ConfigurationError, match=r"Grid.*does not say how long.*SimulatorPlant\(control_dt"):
        _ = bound(Grid()).control_dt
    assert bound(Grid(), control_dt=0.5).control_dt == 0.5
    shield = sw.constraints.PredictiveShield("cost", 2, backup=[0, 1, 2, 3])
    with pytest.raises(ConfigurationError, match="control_dt"):
        sw.StuckEscape(sw.ActionShield(Grid(), [shield]))


def test_a_reset_that_changes_the_model_is_followed():
    class Heavier(HalfCheetahEnv):
        def reset_model(self):
            self.model.body_mass[1] = self.np_random.uniform(2.0, 20.0)
            return super().reset_model()

    env = gym.wrappers.TimeLimit(Heavier(), 100)
    plant = bound(env, check_steps=20)
    for seed in range(3):
        env.reset(seed=seed)
        plant.executed(None)
        ahead = plant.rollout(np.ones(6), 3).observations
        mine = [env.step(np.ones(6, np.float32))[0] for _ in range(3)]
        np.testing.assert_array_equal(ahead, mine)


def test_the_check_goes_on_in_a_new_episode_where_one_is_truncated():
    class Counted(Cart):
        resets = 0

        def reset(self, *, seed=None, options=None):
            Counted.resets += 1
            return super().reset(seed=seed)

    bound(TimeLimit(Counted(), 5), check_steps=50)
    assert Counted.resets >= 10


def test_the_check_costs_about_as_many_steps_as_it_makes():
    class Counted(Cart):
        made = 0

        def step(self, action):
            Counted.made += 1
            return super().step(action)

    bound(Counted(), check_steps=200)
    assert 400 <= Counted.made <= 440


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
@pytest.mark.parametrize("snapshot", [None, "restored"])
def test_noise_of_any_generator_is_foreseen_only_if_told(kind, where, snapshot):
    def restore(raw, saved):
        raw.x, raw.v = saved[0]
        if where == "env":
            raw.held = saved[1]

    save = (
        (lambda raw: ((raw.x, raw.v), copy.deepcopy(raw.held)))
        if where == "env"
        else (lambda raw: ((raw.x, raw.v),))
    )
    for same_noise in (True, False):
        drawn = [GENERATORS[kind](7) for _ in range(2)]
        envs = [OwnNoise(g) if where == "env" else NoisyActions(Cart(), g) for g in drawn]
        plant = bound(
            envs[0],
            same_noise=same_noise,
            check_steps=0,
            snapshot=None if snapshot is None else (save, restore),
        )
        for env in envs:
            env.reset(seed=0)
        first = envs[0].step(np.ones(1))[0]  # of a pair of Gaussian numbers
        assert first.tobytes() == envs[1].step(np.ones(1))[0].tobytes()
        ahead = [plant.rollout(np.ones(1), 1).observations[0].tobytes() for _ in range(2)]
        assert ahead[0] == ahead[1], "the samples of one step are the same for all candidates"
        real, bare = (env.step(np.ones(1))[0].tobytes() for env in envs)
        assert real == bare, "the env itself draws on as it would"
        assert (ahead[0] == real) == same_noise


def test_noise_that_is_the_same_in_all_of_the_process_is_not_foreseen_either():
    class Global(Cart):
        def step(self, action):
            return super().step(np.asarray(action) * 0.5 + 0.1 * np.random.randn() + 0.1 * random.gauss(0, 1))

    plant = bound(Global(), same_noise=False, check_steps=0)
    env = plant.simulation.env
    env.reset(seed=0)
    np.random.seed(3), random.seed(3)
    before = np.random.get_state()[1].tobytes(), random.getstate()
    ahead = plant.rollout(np.ones(1), 3).observations[0]
    assert (np.random.get_state()[1].tobytes(), random.getstate()) == before
    assert ahead.tobytes() != env.step(np.ones(1))[0].tobytes()


def test_other_noise_that_changes_nothing_is_told():
    with pytest.warns(UserWarning, match="same_noise=False changes nothing in"):
        bound(Cart(), same_noise=False, check_steps=20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bound(NoisyCart(), same_noise=False, check_steps=20)
        bound(OwnNoise(random.Random(7)), same_noise=False, check_steps=20)


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
    assert own.promise == "best effort"


def test_a_vector_env_flags_such_a_step_too():
    made = gym.vector.SyncVectorEnv(
        [lambda: gym.wrappers.TimeLimit(LateNoise(), 101)] * 2,
        autoreset_mode=gym.vector.AutoresetMode.SAME_STEP,
    )
    shield = sw.constraints.PredictiveShield(lambda x: 1.0, 2)
    envs = sw.VectorCBFActionFilter(made, [shield], plant=sw.SimulatorPlant(check_steps=50))
    envs.reset(seed=0)
    for _ in range(100):
        assert not envs.step(np.zeros((2, 1)))[4]["cbf/mismatch"].any()
    with pytest.warns(UserWarning, match="not its simulation's"):
        finals = envs.step(np.zeros((2, 1)))[4]["final_info"]
    assert finals["cbf/mismatch"].all()


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "MountainCarContinuous-v0"])
@pytest.mark.parametrize("form", [np.float32, np.float64, list])
def test_an_action_in_a_finer_dtype_is_simulated_as_it_is_executed(env_id, form):
    shield = sw.constraints.PredictiveShield(lambda x: 1.0, 2)
    env = sw.CBFActionFilter(gym.make(env_id), [shield], plant=sw.SimulatorPlant(check_steps=50))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(env.action_space.low, env.action_space.high)
        info = env.step(action.tolist() if form is list else action.astype(form))[4]
        assert not info["cbf/mismatch"]


class SlowCart(Cart):
    """A cart whose step takes 20 ms."""

    def step(self, action):
        time.sleep(0.02)
        return super().step(action)


def test_the_check_ends_in_time_and_says_on_how_many_steps_it_was_made():
    begun = time.monotonic()
    with pytest.warns(UserWarning, match=r"SlowCart.* on \d+ random steps.* instead of 1,000"):
        plant = bound(SlowCart(), check_s=0.4)
    assert time.monotonic() - begun < 4.0  # all of them take 40 s
    assert 0 < plant.checked_steps <= 30
    quick = bound(Cart(), check_steps=20, check_s=60.0)
    assert quick.checked_steps >= 20
    with pytest.raises(ConfigurationError, match="check_s"):
        sw.SimulatorPlant(check_s=0.0)
