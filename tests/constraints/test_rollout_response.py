"""For how long a rollout constraint keeps the response of its forecasts, on a plant of one line of arithmetic."""

from types import SimpleNamespace

import numpy as np
import pytest

from safe_wrappers.constraints.rollout import BoundRollout, RolloutMemory

INSTANTS = 8
"""Of a control interval."""


class Approaching(BoundRollout):
    """What is left of a bound on the first control, which acts the more the later it is."""

    def __init__(self, plant, margin=0.0, horizon=1):
        self.spec, self.plant, self.max_decrease = (
            SimpleNamespace(
                margin=margin, horizon=horizon, look_ahead_below=None, euler_look_ahead=False, unit="m"
            ),
            plant,
            None,
        )

    def room(self, forecast):
        share = np.linspace(1.0 / INSTANTS, 1.0, INSTANTS)[:, None]
        return self.plant.left - forecast[0] * self.plant.gain * share

    def now(self):
        return np.array([self.plant.left])


def still_plant():
    plant = SimpleNamespace(
        has_acceleration=False, lower=-np.ones(2), upper=np.ones(2), control_dt=0.1, observation_id=0
    )
    plant.left, plant.gain, plant.asked = 0.5, 1.0, []

    def forecast(control, horizon, euler=False):
        plant.asked.append(np.array(control))
        return control

    plant.braking, plant.forecast = lambda: np.zeros(2), forecast
    return plant


def test_a_response_is_kept_for_ten_control_steps():
    plant = still_plant()
    limit, memory, asked = Approaching(plant), RolloutMemory(), []
    for plant.observation_id in range(1, 25):
        limit.observe(memory)
        plant.asked.clear()
        limit.rows()
        asked.append(len(plant.asked))
        limit.rows()
        assert len(plant.asked) == asked[-1]  # once per observation
        memory = limit.executed(np.zeros(2))
    # Of braking twice and one difference for each control, every tenth step; of braking alone between.
    assert asked == [4, *[1] * 9, 4, *[1] * 9, 4, *[1] * 3]


def test_a_new_episode_knows_no_response():
    plant = still_plant()
    limit = Approaching(plant)
    for _ in range(2):
        limit.observe(limit.start())
        plant.asked.clear()
        limit.rows()
        assert len(plant.asked) == 4


def test_the_first_linearisation_takes_the_kept_response_and_the_second_its_own():
    plant = still_plant()
    limit = Approaching(plant)
    limit.observe(RolloutMemory())
    limit.rows()
    plant.gain, asked = 2.0, []
    for _ in range(2):
        plant.asked.clear()
        rows = limit.linearize(np.array([0.9, 0.0]))
        asked.append((len(plant.asked), rows.normals[:, 0].max()))
    assert asked == [(1, pytest.approx(1.0)), (4, pytest.approx(2.0))]


def test_rows_are_made_of_a_few_instants_and_the_last():
    plant = still_plant()
    limit = Approaching(plant)
    plant.left = 0.1  # all instants could break it
    limit.observe(RolloutMemory())
    rows = limit.rows()
    np.testing.assert_allclose(rows.normals[:, 0] * INSTANTS, [1, 2, 3, 5, 8], rtol=1e-6)
    np.testing.assert_allclose(rows.normals[:, 1], 0.0)
    np.testing.assert_allclose(rows.offsets, 0.1, rtol=1e-4)
    plant.left = 0.5  # only those later than half of the interval
    limit.observe(RolloutMemory())
    np.testing.assert_allclose(limit.rows().normals[:, 0] * INSTANTS, [5, 8], rtol=1e-6)


def test_the_rows_of_a_state_outside_ask_for_the_way_back_at_the_end():
    plant = still_plant()
    limit = Approaching(plant, margin=0.6)  # 0.1 beyond it
    limit.observe(RolloutMemory())
    rows = limit.rows()
    back = 0.1 - 0.1 * np.exp(-1.0)  # in one control interval of 0.1 s
    np.testing.assert_allclose(rows.normals[:, 0] * INSTANTS, [1, 2, 3, 5, 8], rtol=1e-6)
    np.testing.assert_allclose(rows.offsets, [0.0, 0.0, 0.0, 0.0, -1.01 * back], atol=1e-5)


@pytest.mark.parametrize("control", [-1.0, -0.2, 0.0, 0.7, 1.0])
def test_differences_stay_inside_the_bounds(control):
    plant = still_plant()
    limit = Approaching(plant)
    limit.observe(RolloutMemory())
    limit._respond(np.array([control, -control]))
    assert (np.abs(plant.asked) <= 1.0).all()
    np.testing.assert_allclose(limit._response[0][-1], [[-1.0, 0.0]], atol=1e-9)


def test_rows_of_a_limit_far_away_are_none():
    plant = still_plant()
    limit = Approaching(plant)
    limit.max_decrease = 0.1
    limit.observe(RolloutMemory())
    assert not limit.rows().offsets.size and limit.admits(np.ones(2)) and not plant.asked
    limit.max_decrease = 0.5000001
    limit.observe(RolloutMemory())
    assert limit.rows().offsets.size and not limit.admits(np.ones(2))


def test_only_as_many_states_are_remembered_as_are_looked_ahead():
    plant = still_plant()
    limit = Approaching(plant, horizon=3)
    limit.max_decrease = 9.0
    memory = limit.start()
    for plant.left in (5.0, 4.0, 3.0, 2.0, 1.0):
        limit.observe(memory)
        memory = limit.executed(np.zeros(2))
    assert memory.least == (3.0, 2.0, 1.0)
