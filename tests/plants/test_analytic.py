"""AnalyticPlant: the user's f and g on Pendulum, against the env and SciPy; a step's length is never assumed."""

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


def test_state_f_and_g_are_the_pendulums_and_where_a_control_leads_is_scipys():
    env = gym.make("Pendulum-v1")
    env.reset(seed=0)
    plant, rng = plant_on(env), np.random.default_rng(0)
    for _ in range(30):
        env.unwrapped.state = x = np.array([rng.uniform(-3, 3), rng.uniform(-4, 4)])
        u = rng.uniform(-2, 2, 1)
        plant.observe()
        np.testing.assert_array_equal(plant.state, x)
        rate = plant.f + plant.g @ u
        exact = solve_ivp(
            lambda t, y, u=u: [y[1], 15.0 * np.sin(y[0]) + 3.0 * u[0]],
            (0.0, 0.05),
            x,
            t_eval=[0.025, 0.05],
            rtol=1e-12,
            atol=1e-12,
        ).y.T
        np.testing.assert_allclose(plant.integrate(x, u, 0.05), exact[1], atol=1e-7)
        half, end, by_euler = plant.rollout(u).states
        np.testing.assert_allclose(half, exact[0], atol=0.02)  # of first order: 0.025^2 / 2 s^2 * 60 rad/s^3
        np.testing.assert_allclose(end, plant.integrate(x, u, 0.05, substeps=1), atol=1e-12)
        np.testing.assert_allclose(by_euler, x + 0.05 * rate, atol=1e-12)
        np.testing.assert_array_equal(plant.rollout(None).states, [x])
        env.step(u)
        # Pendulum integrates by semi-implicit Euler: its speed is exact for the rate at the start of the step.
        assert env.unwrapped.state[1] == pytest.approx(by_euler[1], abs=1e-12)
    with pytest.raises(ConfigurationError, match=r"predicts one control interval.* got a horizon of 2"):
        plant.rollout(u, 2)


def on_a_mountain(dt=None, **timing):
    """A filter of MountainCar, whose step is a second, and which says nothing of its time unless told."""
    env = gym.make("MountainCarContinuous-v0")
    if dt is not None:
        env.unwrapped.dt = dt
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], -0.0025 * np.cos(3.0 * x[0])]),
        g=lambda x: np.array([[0.0], [0.0015]]),
        state=lambda env: env.state,
        **timing,
    )
    return sw.CBFActionFilter(env, [sw.constraints.Barrier(lambda x: 0.01 - x[1])], plant=plant)


def test_a_step_of_unknown_length_is_asked_for_and_not_assumed():
    with pytest.raises(ConfigurationError, match=r"no attribute dt\): pass control_dt, in seconds"):
        on_a_mountain()
    for timing in ({"control_dt": 1.0}, {"dt": 1.0}, {"dt": 1.0, "control_dt": 1.0}):
        filtered = on_a_mountain(**timing)
        assert filtered.plant.control_dt == 1.0
        filtered.reset(seed=0)
        speeds = [filtered.step(np.ones(1, np.float32))[0][1] for _ in range(20)]
        assert 0.009 < max(speeds) <= 0.01 + 1e-7  # of float32


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control_dt": 0.02}, r"control_dt = 0.02 s, but one step of this env lasts dt = 0.05 s"),
        ({"control_dt": 0.0}, r"control_dt must be a finite number > 0 in s, got 0.0"),
        ({"delay_s": -0.1}, r"delay_s must be a finite number >= 0 in s, got -0.1"),
        (
            {"f": lambda x: np.zeros(3)},
            r"shapes \(states,\) and .* \(2,\) and \(2, 1\), got \(3,\) and \(2, 1\)",
        ),
        ({"g": 3.0}, "g must be a function, got 3.0"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    env = gym.make("Pendulum-v1")
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match=message):
        plant = plant_on(env, **changes)
        plant.observe()
        _ = plant.f
