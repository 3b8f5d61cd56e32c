"""AnalyticPlant: shapes, time step, delay; on Pendulum and MountainCar against the envs themselves."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

PENDULUM = {
    "f": lambda x: np.array([x[1], 15.0 * np.sin(x[0])]),
    "g": lambda x: np.array([[0.0], [3.0]]),
    "state": lambda env: env.state,
    "control_dt": 0.05,
}


def plant_on(env, **changes):
    plant = sw.AnalyticPlant(**{**PENDULUM, **changes})
    plant.bind(env)
    return plant


def test_pendulum_state_f_and_g():
    env = gym.make("Pendulum-v1")
    env.reset(seed=0)
    plant = plant_on(env)
    rng = np.random.default_rng(0)
    for _ in range(30):
        env.unwrapped.state = np.array([rng.uniform(-3, 3), rng.uniform(-4, 4)])
        plant.observe()
        np.testing.assert_array_equal(plant.state, env.unwrapped.state)
        u = rng.uniform(-2, 2, 1)
        before = plant.state.copy()
        env.step(u)
        # Pendulum integrates by semi-implicit Euler: its speed is exact for f + g u at the start of the step
        assert env.unwrapped.state[1] == pytest.approx(
            before[1] + 0.05 * (plant.f + plant.g @ u)[1], abs=1e-12
        )
    assert isinstance(plant, sw.Plant)


class Slow(gym.Env):
    """A cart, v' = u, in steps of 1 s; it says nothing of its time unless told."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))

    def __init__(self, **told):
        vars(self).update(told)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.v = np.zeros(1)
        return self.v, {}

    def step(self, action):
        self.v = self.v + 1.0 * action
        return self.v, 0.0, False, False, {}


def on_cart(env, **timing):
    plant = sw.AnalyticPlant(np.zeros_like, lambda x: np.eye(1), lambda env: env.v, **timing)
    return sw.CBFActionFilter(env, [sw.constraints.Barrier(lambda x: 1.5 - x[0])], plant=plant)


def test_a_step_of_unknown_length_is_asked_for_and_not_assumed():
    # With an assumed 0.05 s every step of this env left the limit behind, some of them unflagged.
    with pytest.raises(ConfigurationError, match=r"Slow.* no attribute dt\): pass control_dt, in seconds"):
        on_cart(Slow())
    for filtered in (
        on_cart(Slow(), control_dt=1.0),
        on_cart(Slow(dt=1.0)),
        on_cart(Slow(dt=1.0), control_dt=1.0),
    ):
        assert filtered.plant.control_dt == 1.0
        filtered.reset(seed=0)
        for _ in range(6):
            filtered.step(np.ones(1, np.float32))
            assert filtered.unwrapped.v[0] <= 1.5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control_dt": 0.02}, r"control_dt = 0.02 s, but one step of this env lasts dt = 0.05 s"),
        ({"control_dt": -0.05}, r"control_dt must be a finite number > 0 in s, got -0.05"),
        ({"control_dt": 0.0}, r"control_dt must be a finite number > 0 in s, got 0.0"),
        ({"control_dt": np.nan}, r"control_dt must be a finite number > 0 in s, got nan"),
        ({"delay_s": -0.1}, r"delay_s must be a finite number >= 0 in s, got -0.1"),
        ({"delay_s": np.inf}, r"delay_s must be a finite number >= 0 in s, got inf"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        plant_on(gym.make("Pendulum-v1"), **changes)


def test_integration_agrees_with_scipy():
    env = gym.make("Pendulum-v1")
    env.reset(seed=0)
    plant = plant_on(env)
    x = np.array([0.3, -1.0])
    exact = solve_ivp(
        lambda t, y: [*(PENDULUM["f"](y) + np.array([0.0, 4.5]))], (0, 0.05), x, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(plant.integrate(x, np.array([1.5]), 0.05), exact.y[:, -1], atol=1e-8)


def delayed(delay, commands):
    """A double integrator that starts at (0.2, 1.5), with `commands` sent since the reset."""
    env = gym.make("Pendulum-v1")
    env.reset(seed=0)
    env.unwrapped.state = np.array([0.2, 1.5])
    plant = plant_on(
        env, f=lambda x: np.array([x[1], 0.0]), g=lambda x: np.array([[0.0], [1.0]]), delay_s=delay
    )
    plant.executed(None)
    for u in commands:
        plant.executed(np.array([u]))
    plant.observe()
    hold, now = 0.05, 0.05 * len(commands)
    x, v = 0.2, 1.5
    cuts = sorted({0.0, delay, *(k * hold + delay - now for k in range(len(commands) + 1))})
    cuts = [c for c in cuts if 0.0 <= c <= delay + 1e-12]
    for start, end in itertools.pairwise(cuts):
        if end - start < 1e-12:
            continue
        k = int(np.floor((now + 0.5 * (start + end) - delay) / hold))
        a = commands[k] if k >= 0 else 0.0
        span = end - start
        x, v = x + v * span + 0.5 * a * span**2, v + a * span
    np.testing.assert_allclose(plant.state, [x, v], atol=1e-9)


@pytest.mark.parametrize("delay", [0.05, 0.1, 0.15])
def test_delay_of_whole_holds(delay):
    delayed(delay, [0.3, -0.7, 1.0, 0.4])


@pytest.mark.parametrize("delay", [0.02, 0.07, 0.13])
def test_delay_of_fractions_of_a_hold(delay):
    delayed(delay, [0.3, -0.7, 1.0, 0.4])
