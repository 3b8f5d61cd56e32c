"""IdentifiedPlant: its promise on fresh episodes, its rollouts, its monitor, and what it refuses."""

import math

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import binom

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants import View


class CartInWind(gym.Env):
    """A cart of 1 kg on a rail, pushed by up to 4 N and by the drag of a wind that nobody measures.

    The drag is 0.3 kg/m (v - w)|v - w|; w is an Ornstein-Uhlenbeck process with a time constant of 1 s and a standard
    deviation of `wind` m/s.
    """

    def __init__(self, wind=1.0):
        self.wind, self.dt = wind, 0.05
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._x, self._v = self.np_random.uniform(-1.0, 1.0), 0.0
        self._w, self._steps = self.wind * self.np_random.standard_normal(), 0
        return np.array([self._x, self._v]), {}

    def step(self, action):
        keep = math.exp(-self.dt)
        self._w = keep * self._w + self.wind * math.sqrt(1.0 - keep**2) * self.np_random.standard_normal()
        against = self._v - self._w
        self._v += self.dt * (4.0 * float(action[0]) - 0.3 * against * abs(against))
        self._x += self.dt * self._v
        self._steps += 1
        return np.array([self._x, self._v]), 0.0, False, self._steps >= 200, {}


def wall(view):
    return 2.0 - abs(view.observation[0])


def logs_of(episodes, seed=0, steps=60, wind=1.0):
    return sw.plants.log_steps(CartInWind(wind), episodes=episodes, seed=seed, max_steps=steps)


@pytest.fixture(scope="module")
def logs():
    return logs_of(100, steps=200)


def plant_on(env, logs, **more):
    plant = sw.IdentifiedPlant(logs, **more)
    plant.bind(env)
    return plant


def fresh_window(plant, margins, episode, place):
    """Whether a window of an episode keeps the margins; written without the plant's own windows."""
    horizon = len(margins)
    start = int(place * (len(episode.actions) - horizon + 1))
    state = episode.observations[start]
    for step in range(horizon):
        state = plant.model(state[None], episode.actions[start + step][None])[0]
        true = wall(View(None, episode.observations[start + step + 1], {}))
        if true < wall(View(None, state, {})) - margins[step]:
            return False
    return True


def test_windows_of_fresh_episodes_miss_as_often_as_promised():
    draw = np.random.default_rng(0)
    misses, trials = 0, 100
    for trial in range(trials):
        logged = logs_of(39, seed=trial, steps=25)
        # One fresh episode per plant: misses of different plants are independent.
        plant = sw.IdentifiedPlant(logged[:38], miss_rate=0.2, seed=trial)
        assert len(plant.held_out_episodes) == 19
        margins = plant.margins(wall, 12)
        misses += not fresh_window(plant, margins, logged[38], draw.random())
    low, high = binom.interval(0.999, trials, 4 / 20)
    assert low <= misses <= high


def test_margins_are_the_conformal_bound_of_one_window_per_held_out_episode(logs):
    plant = sw.IdentifiedPlant(logs, miss_rate=0.1, seed=3)
    margins = plant.margins(wall, 15)
    assert margins.shape == (15,) and (margins >= 0.0).all() and margins[-1] > margins[0]
    # Of 50 held-out windows the four with the largest scores miss, and the fifth lies on the bound: 5 of 51,
    # with the next one, are one tenth.
    windows = list(zip(plant.held_out_episodes, plant._places, strict=True))
    for factor, missing in ((1.0 + 1e-9, 4), (1.0 - 1e-9, 5)):
        kept = [fresh_window(plant, factor * margins, *window) for window in windows]
        assert kept.count(False) == missing
    both = {id(one) for one in plant.held_out_episodes} & {id(one) for one in plant.fit_episodes}
    assert not both and len(plant.held_out_episodes) == len(plant.fit_episodes) == 50


def test_a_rollout_repeats_the_model_and_knows_no_rewards(logs):
    env = CartInWind()
    plant = plant_on(env, logs)
    plant.received(*env.reset(seed=0))
    seen = []

    def policy(view):
        assert view.env is None and view.info == {}
        seen.append(view.observation)
        return np.array([-5.0])  # boxed

    found = plant.rollout(np.array([0.5]), 4, policy, wall)
    state = plant.state
    for control, observation, value in zip([0.5, -1, -1, -1], found.observations, found.values, strict=True):
        state = plant.model(state[None], np.array([[control]], dtype=float))[0]
        np.testing.assert_array_equal(state, observation)
        assert value == wall(View(None, state, {}))
    assert np.isnan(found.rewards).all() and len(found.rewards) == 4 and len(seen) == 3
    assert not found.ended and not found.reached
    held = plant.rollout(np.array([0.5]), 3)
    assert len(held.observations) == 3 and held.values == []
    assert len(plant.rollout(np.array([0.5]), 9, measure=wall, least=math.inf).values) == 1
    assert plant.rollout(np.array([0.5]), 9, until=lambda view: True).reached


def shielded(env, plant, **more):
    def back(x):
        return np.clip([-2.0 * x[0] - 2.0 * x[1]], -1.0, 1.0)

    shield = sw.constraints.PredictiveShield(lambda x: 2.0 - abs(x[0]), 20, [back, "hold"], **more)
    return sw.CBFActionFilter(env, [shield], plant=plant)


def outward(observation):
    return np.array([1.0 if observation[0] > 0.0 else -1.0])


def drive(env, episodes, policy=outward):
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        yield observation, info, True
        over = False
        while not over:
            observation, _, _, over, info = env.step(policy(observation))
            yield observation, info, False


@pytest.fixture(scope="module")
def varied():
    """Logs of a driver that also pushes outward."""
    found = []
    for seed in range(100):
        draw = np.random.default_rng(seed)
        mode = draw.integers(2, size=20)
        steps = iter(range(10**6))
        held = draw.uniform(-1.0, 1.0, 20)

        def policy(x, mode=mode, held=held, steps=steps):
            block = next(steps) // 10
            return outward(x) if mode[block] else held[block : block + 1]

        found += sw.plants.log_steps(CartInWind(), policy, 1, seed)
    return found


def test_a_shield_on_it_keeps_a_cart_from_the_wall(varied):
    env = shielded(CartInWind(), sw.IdentifiedPlant(varied, miss_rate=0.05))
    out = changed = 0
    for observation, info, _ in drive(env, 5):
        out += abs(observation[0]) > 2.0
        changed += info["cbf/intervened"]
    assert out == 0 and changed > 100
    assert max(abs(x[0]) for x, _, _ in drive(CartInWind(), 5)) > 10.0


def test_what_is_judged_is_the_next_measure_against_its_prediction(logs):
    env = CartInWind()
    plant = plant_on(env, logs)
    margin = plant.margins(wall, 1)[0]
    plant.received(*env.reset(seed=0))
    plant.executed(None)
    assert math.isnan(plant.info()["plant/coverage"])
    for fall, coverage in ((0.999, 1.0), (1.001, 0.5)):
        control = np.array([0.3])
        expected = wall(View(None, plant.model(plant.state[None], control[None])[0], {}))
        plant.executed(control)
        plant.received(np.array([2.0 - (expected - fall * margin), 0.0]), {})
        assert plant.info()["plant/coverage"] == coverage
    plant.executed(np.array([0.3]))
    plant.received(np.array([np.nan, 0.0]), {})  # no number is no coverage
    assert plant.info()["plant/coverage"] == pytest.approx(1 / 3)
    plant.executed(np.array([0.3]))
    plant.received(np.zeros(2), {})  # from a state that is no number nothing was predicted
    assert plant.info()["plant/coverage"] == pytest.approx(1 / 3)
    plant.received(np.zeros(2), {})  # a reset
    assert plant.info()["plant/coverage"] == pytest.approx(1 / 3)
    plant.executed(None)
    assert math.isnan(plant.info()["plant/coverage"])


def test_another_env_is_refused(logs):
    with pytest.raises(UnsupportedEnvError, match=r"observations of shape \(2,\), Pendulum-v1 has \(3,\)"):
        plant_on(gym.make("Pendulum-v1"), logs)
    with pytest.raises(UnsupportedEnvError, match=r"actions of shape \(2,\), .* has \(1,\)"):
        plant_on(CartInWind(), [(o, np.repeat(a, 2, axis=1)) for o, a in logs])


def test_an_h_that_is_no_number_is_refused(logs):
    plant = sw.IdentifiedPlant(logs)
    with pytest.raises(ConfigurationError, match="rollouts over 5 steps give no finite h"):
        plant.margins(lambda view: math.nan, 5)
    assert (plant.margins(lambda view: math.inf, 5) == 0.0).all()
