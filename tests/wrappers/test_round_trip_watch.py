"""RoundTripWatch: the appendix's ceiling from measured clearance and speed, and the stop that needs no operator."""

import json

import gymnasium as gym
import numpy as np
import pytest
from teleop_worlds import ceiling, place

import safe_wrappers as sw
from safe_wrappers.checks import settings_from
from safe_wrappers.envs.teleop_contact import CLAMP_Y, TOOL_RADIUS
from safe_wrappers.serialize import plain_data
from safe_wrappers.wrappers.teleop import RoundTripWatch

ROOM = CLAMP_Y - TOOL_RADIUS
HOLD = 0.001


def watch(env, wanted):
    made = RoundTripWatch(env, wanted, HOLD)
    plant = made.budget.plant_of(None)
    if plant is not None:
        plant.bind(env)
    made.budget.bind(plant)
    made.reset()
    return made


@pytest.fixture
def env():
    made = gym.make("TeleopContact-v0")
    made.reset(seed=0)
    return made


@pytest.mark.parametrize("speed", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("y", [-0.4, 0.0, 0.2])
def test_the_ceiling_is_the_appendixs_formula_less_one_step(env, speed, y):
    wanted = ceiling(video_s=0.1, human_s=0.2, act_s=0.01, localisation=0.002, margin=0.003, longest_s=100.0)
    looking = watch(env, wanted)
    place(env, (0.0, y), (0.0, speed))
    looking.look()
    clearance = ROOM - y
    by_hand = (clearance - 0.002 - 0.003 - speed**2 / 48.0) / speed - (0.1 + 0.2 + 0.01) - HOLD
    assert looking.ceiling_s == pytest.approx(by_hand, abs=1e-9)


def test_what_recedes_or_stands_has_the_highest_ceiling_there_is(env):
    looking = watch(env, ceiling(longest_s=2.0))
    for velocity in ((0.0, 0.0), (0.0, -0.5), (0.9, 0.0)):
        place(env, (0.0, 0.0), velocity)
        looking.look()
        assert looking.ceiling_s == 2.0
    place(env, (0.0, ROOM - 0.0005), (0.0, -0.1))  # inside its margin, on its way out
    looking.look()
    assert looking.ceiling_s == 2.0
    place(env, (0.0, 0.234), (0.0, 1.0))
    looking.look()
    assert -2.0 <= looking.ceiling_s < 0.0


def test_far_away_any_command_may_be_executed_and_close_by_only_one_that_can_be_stopped(env):
    looking = watch(env, ceiling())
    place(env)
    looking.look()
    assert looking.budget.can_stop_after(np.array([0.0, 1.0]), HOLD)
    place(env, (0.0, ROOM - 0.001 - 0.00002))  # 20 micrometres before its margin
    looking.look()
    assert not looking.budget.can_stop_after(np.array([0.0, 1.0]), HOLD)
    for away in (0.0, -0.2, -1.0):
        assert looking.budget.can_stop_after(np.array([0.5, away]), HOLD)
    place(env, (0.0, ROOM - 0.02), (0.0, 1.0))  # it needs 0.0208 + 0.001 m to stop
    looking.look()
    assert not looking.budget.can_stop_after(np.array([0.0, 0.0]), HOLD)


def test_the_delay_of_the_brake_is_counted(env):
    place(env, (0.0, ROOM - 0.03), (0.0, 1.0))
    for act_s, possible in ((0.0, True), (0.02, False)):
        looking = watch(env, ceiling(act_s=act_s))
        looking.look()
        assert looking.budget.can_stop_after(np.array([0.0, 0.0]), HOLD) == possible


def approach(env):
    raw = env.unwrapped
    return np.array([raw.clearance, 1.0]), np.array([raw.tool_velocity[1], 0.0])


def test_a_function_of_the_env_measures_as_well(env):
    budget = sw.StoppingBudget(approach, acceleration=55.0, braking=24.0, margin=0.001)
    by_function = watch(env, sw.teleop.RoundTripCeiling(budget, longest_s=9.0))
    by_constraint = watch(env, ceiling(longest_s=9.0))
    place(env, (0.0, 0.1), (0.0, 0.3))
    for looking in (by_function, by_constraint):
        looking.look()
    assert by_function.ceiling_s == pytest.approx(by_constraint.ceiling_s)
    assert by_function.budget.can_stop_after(np.array([0.0, 1.0]), HOLD)
    place(env, (0.0, ROOM - 0.00102))
    by_function.look()  # it knows no command from another: none is admitted
    assert not by_function.budget.can_stop_after(np.array([0.0, -1.0]), HOLD)


@pytest.mark.parametrize("answer", [(np.nan, 0.1), (0.1, np.inf), (-np.inf, 0.0)])
def test_what_cannot_be_read_has_no_ceiling(env, answer):
    looking = watch(
        env, sw.teleop.RoundTripCeiling(sw.StoppingBudget(lambda env: answer, braking=1.0, acceleration=1.0))
    )
    env.reset(seed=0)
    looking.look()
    assert not looking.readable and looking.ceiling_s == -1.0
    assert not looking.budget.can_stop_after(np.zeros(2), HOLD)


def test_a_ceiling_is_plain_data():
    wanted = ceiling(video_s=0.05, release=0.5)
    data = plain_data(wanted)
    assert json.loads(json.dumps(data)) == data
    assert plain_data(settings_from(sw.teleop.RoundTripCeiling, data, "ceiling")) == data
    assert data["budget"]["clearance"]["kind"] == "Clearance"
