"""Stopping insets in one dimension: against exact simulation, with an adversary at the throttle."""

import hashlib

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from safe_wrappers.control.backup import stopping as of
from safe_wrappers.control.backup.stopping import held_limit, held_stop
from safe_wrappers.control.numerics.shapes import clearances_on_a_course, convex_outline

POSITIVE = st.floats(0.05, 5.0)


def simulate(
    start, speed, wall, brake, hold, *, holds_of_delay=0, error=0.0, margin=0.0, strength=None, seed=0
):
    """A point that always wants full throttle, limited by what is promised; commands act late, x is off.

    Returns the exact closest approach to the wall between samples too, and the smallest inset.
    """
    strength = brake if strength is None else strength
    rng = np.random.default_rng(seed)
    x, v, queue = start, speed, [0.0] * holds_of_delay
    closest, smallest = wall - x, np.inf
    for _ in range(int(30 / hold)):
        measured = wall - x + error * rng.uniform(-1, 1)
        # exact over the commands in flight, one after the other
        room, fast = measured, v
        for a in queue:
            room, fast = room - fast * hold - 0.5 * a * hold**2, fast + a * hold
        room -= error + margin
        smallest = min(smallest, room - held_stop(fast, brake, hold))
        limit = held_limit(room, fast, brake, hold)
        queue.append(float(np.clip(min(strength, limit), -brake, strength)))
        a = queue.pop(0)
        turn = -v / a if a < 0 else np.inf
        peak = x + v * turn + 0.5 * a * turn**2 if 0 < turn < hold else x
        x, v = x + v * hold + 0.5 * a * hold**2, v + a * hold
        closest = min(closest, wall - max(x, peak))
    return closest, smallest


@pytest.mark.parametrize("hold", [0.02, 0.1, 0.4])
@pytest.mark.parametrize("strength", [1.0, 3.0])
def test_full_throttle_stops_at_the_wall_and_close_to_it(hold, strength):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        speed = rng.uniform(0, 1.5)
        room = speed**2 / 2.0 + hold**2 / 8 + rng.uniform(0.2, 2.0)
        closest, smallest = simulate(0.0, speed, room, 1.0, hold, strength=strength, seed=seed)
        assert closest >= -1e-9
        assert closest < 1e-3 + 1e-3 * hold
        assert smallest >= -1e-9


@given(st.floats(0, 3), st.floats(-2, 3), POSITIVE, st.floats(0.005, 0.5))
def test_braking_is_always_admissible_inside_the_set(clearance, speed, brake, hold):
    inset = clearance - held_stop(speed, brake, hold)
    assume(inset >= 0.0)
    limit = float(held_limit(clearance, speed, brake, hold))
    assert limit >= -brake - 1e-9 * max(1.0, brake) - 1e-9 * abs(speed) / hold
    # and so is what it admits: the inset after a hold at the limit (or at full braking) is not negative
    for a in {min(limit, 10.0), max(-brake, min(limit, -brake))}:
        after = clearance - speed * hold - 0.5 * a * hold**2
        inset_after = after - held_stop(speed + a * hold, brake, hold)
        assert inset_after >= -1e-9 * (1 + abs(speed))


@given(st.floats(0, 3), st.floats(-2, 3), POSITIVE, st.floats(0.005, 0.5))
def test_the_limit_is_the_largest(clearance, speed, brake, hold):
    # A little more acceleration than the limit leaves the set, at the end of the hold: nothing is given away.
    assume(clearance - held_stop(speed, brake, hold) >= 1e-6)
    limit = float(held_limit(clearance, speed, brake, hold))
    more = limit + 1e-3 * max(1.0, abs(limit))
    after = clearance - speed * hold - 0.5 * more * hold**2
    assert after - held_stop(speed + more * hold, brake, hold) < 1e-12


@given(st.floats(-1, -0.001), st.floats(-1, 2), POSITIVE, st.floats(0.01, 0.3))
def test_outside_of_the_set_the_limit_is_finite_and_retreats(clearance, speed, brake, hold):
    limit = float(held_limit(clearance, speed, brake, hold))
    assert np.isfinite(limit)
    after = clearance - speed * hold - 0.5 * limit * hold**2
    end = speed + limit * hold
    back_inside = after - held_stop(end, brake, hold) >= -1e-9
    assert back_inside or (end < 0.0 and after - end * hold > after)


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


def seen(distance, normal, velocity=(0.0,), curvature=(0.0,)):
    return of.Nearest(*(np.array([part], dtype=float) for part in (distance, normal, velocity, curvature)))


def test_a_row_that_is_not_a_number_is_kept():
    machine = of.Machine(np.array([-1.0]), np.array([1.0]), 0.0, 0.05, 0.0, 2.0, 0.0)
    for drift, rows in ((0.0, 0), (np.nan, 1)):
        found = of.approach_rows(seen(9.0, [1.0]), np.zeros(1), np.array([drift]), np.ones((1, 1)), machine)
        assert found[1].shape == (rows, 1) and found[2].shape == (rows,)


def test_an_open_bound_is_never_too_weak_to_matter():
    machine = of.Machine(np.array([-1.0]), np.array([np.inf]), 0.0, 0.05, 0.0, 2.0, 0.0)
    for effect, rows in ((1.0, 1), (0.0, 0)):
        found = of.approach_rows(seen(9.0, [1.0]), np.zeros(1), np.zeros(1), np.full((1, 1), effect), machine)
        assert len(found[2]) == rows


# Compiled and plain Python: the same bits of what `CoastingClearance` computes


def random_looks(count):
    """Random scenes, as one digest."""
    rng, digest = np.random.default_rng(5), hashlib.sha256()
    for i in range(count):
        outline = convex_outline(rng.normal(size=(6, 2))) if i % 2 else np.zeros((0, 2))
        ahead = rng.normal(size=(3, 2))
        ahead /= np.sqrt((ahead**2).sum(axis=1))[:, None]
        places, discs = rng.normal(size=(3, 2)), np.abs(rng.normal(size=(4, 3)))
        digest.update(clearances_on_a_course(outline, places, ahead, discs).tobytes())
    return digest.hexdigest()
