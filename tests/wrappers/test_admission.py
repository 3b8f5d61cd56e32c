"""Chunks whose end is out of reach, by kinds of arrival; the oracle is a motion that gets there, or cannot."""

import gymnasium as gym
import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.wrappers.admission import Admission

LIMITS = {"max_acceleration": 2.0, "max_speed": 1.0, "max_jerk": 8.0}


class Nowhere(gym.Env):
    """Says nothing of where it is."""


def admission(state, arrival="moving", **changed):
    motion_limits = {**LIMITS, "arrival": arrival, **changed}
    return Admission(Nowhere(), motion_limits, lambda env: state, len(state[0]))


def quickest(start, end):
    """Ruckig's time to a moving end, one axis."""
    request = ruckig.InputParameter(1)
    request.current_position, request.current_velocity, request.current_acceleration = ([x] for x in start)
    request.target_position, request.target_velocity, request.target_acceleration = ([x] for x in end)
    request.max_velocity, request.max_acceleration, request.max_jerk = [1.0], [2.0], [8.0]
    trajectory = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(request, trajectory)
    return trajectory.duration


numbers = st.integers(-800, 800).map(lambda thousandths: thousandths / 1000.0)


@given(numbers, numbers, st.floats(-0.4, 0.4), st.floats(-0.9, 0.9), st.floats(0.0, 0.5))
def test_what_a_motion_reaches_is_admitted_and_rest_needs_the_constrained_time(q, v, a, goal, late):
    v, a = 0.9 * v, a if abs(v) < 0.5 else 0.0  # a start that can keep the speed limit
    needed = quickest((q, v, a), (goal, 0.0, 0.0))
    state = ([q], [v], [a])
    end = np.array([goal])
    assert admission(state, "rest").admits(end, needed + 1e-9 + late)
    assert admission(state).admits(end, needed + 1e-9 + late)  # what can stop there can pass there
    if needed > 1e-3:
        assert not admission(state, "rest").admits(end, needed * (1.0 - 1e-6) - 1e-9)


def test_moving_admits_ends_at_which_no_machine_could_stop_in_time():
    state = ([0.0, 0.0], [0.9, 0.0], [0.0, 0.0])
    end = np.array([0.09, 0.0])
    assert admission(state).admits(end, 0.1)
    assert not admission(state, "rest").admits(end, 0.1)


def test_every_axis_must_get_there():
    state = ([0.0, 0.0], [0.0, 0.0])
    assert admission(state, max_jerk=np.inf).admits(np.array([0.1, 0.2]), 0.5)
    assert not admission(state, max_jerk=np.inf).admits(np.array([0.1, 0.3]), 0.5)  # 2.0 * 0.5^2 / 2 = 0.25
    assert not admission(state, "rest", max_jerk=np.inf).admits(np.array([0.1, 0.2]), 0.5)  # 2.0 * 0.5^2 / 4


def test_without_a_measured_acceleration_the_most_of_it_is_counted_on():
    still, known = ([0.0], [0.0]), ([0.0], [0.0], [0.0])
    end = np.array([0.2])
    assert admission(still).admits(end, 0.5)
    assert not admission(known).admits(end, 0.5)


def test_the_lengths_of_actuators_are_what_is_measured_by_default():
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    here = env.unwrapped.data.actuator_length.copy()
    asked = Admission(env, {"max_acceleration": 2.0, "max_speed": 1.0}, None, 2)
    env.unwrapped.data.actuator_velocity[:] = 0.0
    assert asked.admits(here + 0.2, 0.5) and not asked.admits(here + 0.3, 0.5)


@pytest.mark.parametrize(
    ("motion_limits", "measured", "error", "words"),
    [
        ({**LIMITS, "arrival": "soon"}, lambda env: ([0.0], [0.0]), UnknownNameError, "'moving' or 'rest'"),
        ({"max_speed": 1.0}, lambda env: ([0.0], [0.0]), ConfigurationError, "max_acceleration"),
        (
            {**LIMITS, "max_speed": [1.0, 2.0]},
            lambda env: ([0.0], [0.0]),
            ConfigurationError,
            "1 action comp",
        ),
        ({**LIMITS, "max_speed": 0.0}, lambda env: ([0.0], [0.0]), ConfigurationError, "max_speed"),
        (LIMITS, None, UnsupportedEnvError, "pass measured"),
    ],
)
def test_bad_limits(motion_limits, measured, error, words):
    with pytest.raises(error, match=words):
        Admission(Nowhere(), motion_limits, measured, 1)


def test_rest_with_limited_jerk_needs_accelerations():
    with pytest.raises(ConfigurationError, match="accelerations"):
        Admission(gym.make("Reacher-v5"), {**LIMITS, "arrival": "rest"}, None, 2)
    with pytest.raises(ConfigurationError, match="accelerations"):
        admission(([0.0], [0.0]), "rest").admits(np.zeros(1), 1.0)
