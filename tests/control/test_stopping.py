"""Stopping insets in one dimension: against exact simulation, with an adversary at the throttle."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from safe_wrappers.control.backup import stopping as of
from safe_wrappers.control.backup.stopping import held_limit, held_stop

STATES = st.floats(0, 3), st.floats(-2, 3), st.floats(0.05, 5.0), st.floats(0.005, 0.5)
"""Clearance, approach speed, braking and hold."""


def held(clearance, speed, acceleration, hold):
    """Clearance and speed at the end of a hold."""
    return clearance - speed * hold - 0.5 * acceleration * hold**2, speed + acceleration * hold


@pytest.mark.parametrize(
    ("hold", "strength", "seed"), [(0.02, 1.0, 0), (0.1, 3.0, 1), (0.4, 1.0, 2), (0.4, 3.0, 3)]
)
def test_full_throttle_stops_at_the_wall_and_close_to_it(hold, strength, seed):
    """A point that always wants full throttle, limited by what is promised; the peaks between samples count."""
    rng, brake = np.random.default_rng(seed), 1.0
    v = rng.uniform(0, 1.5)
    closest = left = v**2 / 2.0 + hold**2 / 8 + rng.uniform(0.2, 2.0)
    for _ in range(int(30 / hold)):
        assert left - held_stop(v, brake, hold) >= -1e-9
        a = float(np.clip(held_limit(left, v, brake, hold), -brake, strength))
        if a < 0 < v < -a * hold:
            closest = min(closest, left + 0.5 * v * v / a)
        left, v = held(left, v, a, hold)
        closest = min(closest, left)
    assert -1e-9 <= closest < 1e-3 + 1e-3 * hold


@given(*STATES)
def test_inside_the_set_braking_is_admissible_and_the_limit_the_most_that_stays_inside(left, v, brake, hold):
    inset = left - held_stop(v, brake, hold)
    assume(inset >= 0.0)
    limit = float(held_limit(left, v, brake, hold))
    assert limit >= -brake - 1e-9 * max(1.0, brake) - 1e-9 * abs(v) / hold
    for a in {min(limit, 10.0), -brake}:
        after, end = held(left, v, a, hold)
        assert after - held_stop(end, brake, hold) >= -1e-9 * (1 + abs(v))
    if inset >= 1e-6:  # a little more leaves it: nothing is given away
        after, end = held(left, v, limit + 1e-3 * max(1.0, abs(limit)), hold)
        assert after - held_stop(end, brake, hold) < 1e-12


@given(st.floats(-1, -0.001), *STATES[1:])
def test_outside_of_the_set_the_limit_is_finite_and_retreats(left, v, brake, hold):
    limit = float(held_limit(left, v, brake, hold))
    assert np.isfinite(limit)
    after, end = held(left, v, limit, hold)
    assert after - held_stop(end, brake, hold) >= -1e-9 or (end < 0.0 and after - end * hold > after)


def test_the_held_stop_is_what_the_best_held_braking_needs():
    # Brute force over the decelerations of every hold, in a coarse grid.
    brake, hold = 1.0, 0.5
    grid = np.linspace(-brake, 0.0, 41)

    def shortest(v, depth=0):
        if v <= 1e-12:
            return 0.0
        if depth == 3:
            return np.inf
        best = np.inf
        for a in grid:
            if v + a * hold < -1e-9:
                continue
            best = min(best, v * hold + 0.5 * a * hold**2 + shortest(max(0.0, v + a * hold), depth + 1))
        return best

    for v in (0.1, 0.25, 0.5, 0.75, 1.0):
        assert held_stop(v, brake, hold) == pytest.approx(shortest(v), abs=1e-9)


@pytest.mark.parametrize(
    ("high", "drift", "effect", "rows"),
    [
        (1.0, 0.0, 1.0, 0),  # too far away to matter
        (1.0, np.nan, 1.0, 1),  # what is not a number is kept
        (np.inf, 0.0, 1.0, 1),  # an open bound is never too weak to matter
        (np.inf, 0.0, 0.0, 0),  # unless it does nothing
    ],
)
def test_a_row_is_left_out_only_where_no_control_exceeds_it(high, drift, effect, rows):
    near = of.Nearest(np.array([9.0]), np.ones((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    machine = of.Machine(np.array([-1.0]), np.array([high]), 0.0, 0.05, 0.0, 2.0, 0.0)
    _, normals, offsets = of.approach_rows(
        near, np.zeros(1), np.array([drift]), np.full((1, 1), effect), machine
    )
    assert normals.shape == (rows, 1) and offsets.shape == (rows,)
