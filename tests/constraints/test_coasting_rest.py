"""CoastingClearance where zero control leaves less than the margin, or does not lead to rest within the horizon."""

import gymnasium as gym
import numpy as np
import pytest
from asking import asked

import safe_wrappers as sw

FULL = np.array([1.0, 1.0])
NONE = np.zeros(2)
RADIUS, MARGIN = 0.2, 0.005


def parked(hazard, speed_up=0, **options):
    """A car at the origin, along x, after `speed_up` steps of full drive; its constraint, and where it is then."""
    env = gym.make("SafeCarGoal1-v0")
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [9.0, 9.0], "hazards": [list(hazard)], "vases": []}
    env.reset(seed=0, options={"layout": layout})
    for _ in range(20):
        env.unwrapped.step(NONE)  # it settles on its wheels
    for _ in range(speed_up):
        env.unwrapped.step(FULL)
    spec = sw.constraints.CoastingClearance([sw.constraints.Discs("hazard_positions", RADIUS)], **options)
    return asked(env, spec), np.array(env.unwrapped.agent_position)


def test_what_does_not_rest_within_the_horizon_is_refused_however_far_it_stays_away():
    for horizon, rests in ((2, False), (12, True)):
        limit, at = parked([5.0, 0.0], speed_up=30, horizon=horizon)
        for control in (FULL, NONE, -FULL):
            assert limit.admits(control) == rests
            assert np.isfinite(limit.value()).all() == rests
            if rests:
                assert 5.0 - RADIUS - at[0] - 0.3 < limit.slack(control) < 5.0 - RADIUS - at[0]
            else:
                assert limit.slack(control) == -np.inf


@pytest.mark.parametrize("gap", [0.001, 0.003, 0.0045])
def test_parked_inside_the_margin_only_the_way_out_is_open(gap):
    ahead, _ = parked([RADIUS + gap, 0.0], margin=MARGIN)
    assert 0.0 < float(ahead.value()[0]) < MARGIN
    assert ahead.admits(-FULL)
    assert not ahead.admits(FULL)
    behind, _ = parked([-RADIUS - gap, 0.0], margin=MARGIN)
    assert behind.admits(FULL)
    assert not behind.admits(-FULL)


def test_what_rest_would_keep_of_the_margin_no_way_out_may_use_up():
    """Full drive past a disc beside the car: a little closer on the way than rest, well clear of it at the end."""

    def beside(angle, **options):
        place = (RADIUS + 0.02) * np.array([np.cos(angle), np.sin(angle)])
        return parked(place, **options)[0]

    def closer(angle):
        limit = beside(angle)
        return limit.slack(NONE) - limit.slack(FULL)

    near, far = 1.5, 1.6  # it drives at the disc, and past it
    assert closer(far) < 0.0 < closer(near)
    for _ in range(40):
        middle = 0.5 * (near + far)
        near, far = (middle, far) if closer(middle) > 5e-7 else (near, middle)
    rest, drive = beside(far).slack(NONE), beside(far).slack(FULL)
    assert 1e-7 < rest - drive < 9e-7  # less than what counts as rounding
    for margin, admitted in ((drive - 1e-7, True), (0.5 * (drive + rest), False), (rest + 1e-7, True)):
        limit = beside(far, margin=margin)
        assert limit.admits(NONE)
        assert limit.admits(FULL) == admitted
