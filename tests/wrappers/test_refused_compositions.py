"""Envs, plants and wrappers with which a filter would be wrong in silence: each is refused, with the remedy."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

LIMITS = [sw.constraints.JointSpeedLimit(2.0)]


def test_one_plant_for_two_envs():
    plant = sw.MujocoPlant()
    sw.CBFActionFilter(gym.make("Reacher-v5"), LIMITS, plant=plant)
    with pytest.raises(ConfigurationError, match=r"bound to another env already; give every filter a plant"):
        sw.CBFActionFilter(gym.make("Reacher-v5"), LIMITS, plant=plant)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: gym.wrappers.StickyAction(env, 0.5),
        lambda env: gym.wrappers.MaxAndSkipObservation(env, skip=4),
        lambda env: gym.wrappers.TransformAction(env, lambda a: -a, env.action_space),
        lambda env: gym.wrappers.RescaleAction(env, -2.0, 2.0),
    ],
)
def test_wrappers_inside_that_change_or_repeat_the_action(wrap):
    with pytest.raises(ConfigurationError, match=r"inside the filter changes the actions .* put it outside"):
        sw.CBFActionFilter(wrap(gym.make("Reacher-v5")), LIMITS)
    wrap(sw.CBFActionFilter(gym.make("Reacher-v5"), LIMITS))  # outside is fine


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Dict(a=gym.spaces.Box(-1.0, 1.0, (2,))),
        gym.spaces.Tuple([gym.spaces.Box(-1.0, 1.0, (2,))]),
        gym.spaces.Discrete(3),
        gym.spaces.Box(-1.0, 1.0, (1, 2)),
        gym.spaces.Box(-1, 1, (2,), np.int64),
    ],
)
def test_actions_that_are_no_vector_of_numbers(space):
    env = gym.make("Reacher-v5").unwrapped
    env.action_space = space
    with pytest.raises(ConfigurationError, match="expected a continuous Box action space of shape"):
        sw.CBFActionFilter(env, LIMITS)


def test_another_control_interval_than_the_env_s():
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 15.0 * np.sin(x[0])]),
        g=lambda x: np.array([[0.0], [3.0]]),
        state=lambda env: env.state,
        control_dt=0.3,
    )
    slow = sw.constraints.Barrier(lambda x: 16.0 - x[1] ** 2)
    with pytest.raises(ConfigurationError, match=r"control_dt = 0\.3 s, but one step of this env lasts"):
        sw.CBFActionFilter(gym.make("Pendulum-v1"), [slow], plant=plant)
