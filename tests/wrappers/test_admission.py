"""Which chunks of setpoints are within reach."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import ruckig
from chunk_worlds import Line
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError

LIMITS = {"acceleration": 2.0, "velocity": 1.0}
SLIDE = '<body><joint name="{0}" type="slide"/><geom size="0.1"/></body>'


class Servos(Line):
    """Position servos of slides, which stay where a test says."""

    def __init__(self, positions, velocities):
        super().__init__(len(positions), -9.0, 9.0, np.float64)
        names = [f"j{i}" for i in range(len(positions))]
        bodies = "".join(map(SLIDE.format, names))
        servos = "".join(f'<position joint="{name}" ctrlrange="-9 9"/>' for name in names)
        text = f"<mujoco><worldbody>{bodies}</worldbody><actuator>{servos}</actuator></mujoco>"
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.data.actuator_length[:], self.data.actuator_velocity[:] = positions, velocities


def handover(env, arrival="moving", **limits):
    limits = {**LIMITS, **limits, "arrival": arrival}
    return sw.ChunkHandover(env, 6, 3, blend_time=0.2, fallback="zero", limits=limits)


def admits(state, end, duration_s, arrival="moving"):
    return handover(Servos(*state), arrival)._admission.admits(np.array(end), duration_s)


def quickest(start, end):
    """Ruckig's time to a moving end, one axis."""
    request = ruckig.InputParameter(1)
    request.current_position, request.current_velocity, request.current_acceleration = ([x] for x in start)
    request.target_position, request.target_velocity, request.target_acceleration = ([x] for x in end)
    request.max_velocity, request.max_acceleration, request.max_jerk = [1.0], [2.0], [math.inf]
    trajectory = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(request, trajectory)
    return trajectory.duration


numbers = st.integers(-800, 800).map(lambda thousandths: thousandths / 1000.0)


@given(numbers, numbers, st.floats(-0.9, 0.9), st.floats(0.0, 0.5))
def test_what_a_motion_reaches_is_admitted_and_rest_needs_the_constrained_time(q, v, goal, late):
    needed = quickest((q, v, 0.0), (goal, 0.0, 0.0))
    state = ([q], [v])
    assert admits(state, [goal], needed + 1e-9 + late, "rest")
    assert admits(state, [goal], needed + 1e-9 + late)  # what can stop there can pass there
    if needed > 1e-3:
        assert not admits(state, [goal], needed * (1.0 - 1e-6) - 1e-9, "rest")


def test_moving_admits_ends_at_which_no_machine_could_stop_in_time():
    state = ([0.0, 0.0], [0.9, 0.0])
    assert admits(state, [0.09, 0.0], 0.1)
    assert not admits(state, [0.09, 0.0], 0.1, "rest")


def test_a_chunk_out_of_reach_is_refused_and_the_left_over_goes_on():
    env = handover(Servos([0.0], [0.0]), acceleration=10.0)
    env.reset(seed=0)
    assert not env.step(np.full((6, 1), 0.1))[4]["handover/refused"]
    assert env.step(np.full((6, 1), 0.9))[4]["handover/refused"]  # 0.6 s at 1 per second
    assert np.ravel(env.unwrapped.given).tolist() == [0.1] * 6


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"arrival": "soon"}, '"moving" or "rest"'),
        ({"acceleration": None}, "beside an acceleration"),
        ({"velocity": [1.0, 2.0]}, "1 action comp"),
        ({"velocity": 0.0}, "limits.velocity"),
    ],
)
def test_bad_limits(limits, words):
    with pytest.raises(ConfigurationError, match=words):
        handover(Servos([0.0], [0.0]), **limits)


def test_limits_are_for_mujocos_actuators():
    with pytest.raises(UnsupportedEnvError, match="MuJoCo's actuators"):
        handover(Line())
    with pytest.raises(ConfigurationError, match="setpoints"):
        handover(gym.wrappers.RescaleAction(Servos([0.0], [0.0]), -1.0, 1.0))
    env = Servos([0.0], [0.0])
    with pytest.raises(ConfigurationError, match="changes the actions"):
        handover(
            gym.wrappers.TransformAction(
                env, lambda action: np.clip(10.0 * action, -9.0, 9.0), env.action_space
            )
        )
