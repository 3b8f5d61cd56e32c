"""What is not seen through closed loops: the corners of the uncertainty, the side of a detour, recovery at rest."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.constraints.backup.base import Detour
from safe_wrappers.control.backup import drive_decision

LAYOUT = {"agent": [0.0, 0.0, 0.0], "goal": [1.2, 1.2], "hazards": [[0.6, 0.0]], "vases": []}


def filtered(layout=None, velocity=(0.0, 0.0, 0.0), **options):
    env = sw.CBFActionFilter(
        gym.make("SafePointGoal1-v0"),
        [sw.constraints.HeadingDriveClearance([sw.constraints.Discs("hazard_positions", 0.2)], **options)],
    )
    env.reset(seed=0, options={"layout": LAYOUT | (layout or {})})
    raw = env.unwrapped
    qvel = raw.data.qvel.copy()
    qvel[:3] = velocity
    raw.set_state(raw.data.qpos.copy(), qvel)
    env.filter.observe()
    return env


def test_a_control_must_be_safe_for_every_corner_of_the_uncertainty():
    env = filtered({"agent": [-0.3, 0.0, 0.0]}, uncertainty=0.25)
    (limit,), raw = env.filter.bound, env.unwrapped
    every, push = limit.models, np.array([0.05, 0.0])
    assert len(every) == 1 + 4  # the body, and its corners

    def refused(x, models):
        qpos, qvel = raw.data.qpos.copy(), raw.data.qvel.copy()
        qpos[0], qvel[0] = x, 0.9
        raw.set_state(qpos, qvel)
        limit.models = models
        env.filter.observe()
        return not limit.admits(push)

    places = np.linspace(-0.4, 0.2, 600)
    by_all = np.array([refused(x, every) for x in places])
    by_one = np.array([refused(x, every[[0, 0]]) for x in places])
    assert by_all[by_one].all()
    assert (by_all & ~by_one).any()


@pytest.mark.parametrize(("beside", "side"), [(0.05, -1.0), (-0.05, 1.0)])
def test_a_disc_ahead_on_the_left_is_passed_on_the_right(beside, side):
    env = filtered({"hazards": [[0.26, beside]]}, detour=True)
    (limit,) = env.filter.bound
    around, turn_only = limit.candidates(np.array([1.0, 0.1]))
    np.testing.assert_array_equal(around, [1.0, side])
    np.testing.assert_array_equal(turn_only, [0.0, side])


def test_a_detour_keeps_its_side_for_fifty_steps_after_it_was_last_needed():
    env = filtered({"hazards": [[0.26, 0.05]]}, detour=True)
    (limit,) = env.filter.bound
    drive = np.array([1.0, 0.1])

    def side(memory):
        limit.observe(memory)
        return limit.candidates(drive)[0][1]

    assert side(Detour()) == -1.0  # on the left: passed on the right
    assert side(Detour(1.0, 1)) == 1.0  # but a detour on the left goes on
    assert limit.executed(drive) == Detour(1.0, 49)
    assert side(Detour(1.0, 0)) == -1.0  # until it has not been needed for long
    assert limit.executed(drive) == Detour(-1.0, 49)
    limit.observe(Detour(-1.0, 49))  # not needed in this step
    assert limit.executed(drive) == Detour(-1.0, 48)
    assert limit.start() == Detour(0.0, 0)


def test_a_position_that_is_no_number_leaves_no_clearance_that_is_one():
    env = filtered()
    env.unwrapped._hazards[:] = np.nan
    env.filter.observe()
    assert np.isnan(env.filter.bound[0].value()).all()


def test_without_brakes_the_backup_rolls_out():
    backups = [
        filtered({"hazards": [[9.0, 9.0]]}, (1.0, 0.0, 0.0), brake=brake).filter.bound[0].backup()
        for brake in (True, False)
    ]
    assert backups[0][0] < 0.0 and backups[1].tolist() == [0.0, 0.0]


def test_no_detour_without_a_drive_or_without_a_disc_ahead():
    env = filtered({"hazards": [[0.26, 0.0]]}, detour=True)
    (limit,) = env.filter.bound
    assert limit.candidates(np.array([0.0, 1.0])) == []
    assert limit.candidates(np.array([-1.0, 0.0])) == []
    env = filtered({"hazards": [[0.26, 0.0]]})
    assert env.filter.bound[0].candidates(np.array([1.0, 0.0])) == []


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
@pytest.mark.parametrize("action", [(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.3, -1.0)])
def test_a_robot_inside_a_hazard_is_brought_out_whatever_the_policy_wants(action):
    env = filtered({"hazards": [[0.05, 0.02]]})
    costs = [env.step(np.array(action, np.float32))[4]["cost_substep"] for _ in range(400)]
    assert costs[0] == 1.0
    assert not any(costs[300:])


def test_a_decision_that_is_not_finite_is_left_to_the_search(monkeypatch):
    env = filtered({"hazards": [[0.29, 0.0]]}, (0.5, 0.0, 0.0))
    (limit,) = env.filter.bound
    bounds = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    assert not limit.admits(np.array([1.0, 0.0])) and limit.decide(np.array([1.0, 0.0]), *bounds) is not None

    def overflowing(*arguments):
        arguments[-1][:] = np.nan
        return drive_decision.ROWS, 0.0, np.zeros((0, 2)), np.zeros(0)

    monkeypatch.setattr(drive_decision, "closest_admitted", overflowing)
    assert limit.decide(np.array([1.0, 0.0]), *bounds) is None
    assert np.isfinite(env.filter.filter(np.array([1.0, 0.0])).control).all()
