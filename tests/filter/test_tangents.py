"""Tangents by differences and by secants: when each is made, and that secants explain what was seen."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safe_wrappers.filter.linearize import Tangents, differences

numbers = st.floats(-3.0, 3.0)


def tangents(slacks, made=None, rows=None):
    """Of slacks of two controls; `made` counts the differences, of which the first `rows` are given."""

    def slopes(control):
        if made is not None:
            made.append(control)
        return differences(slacks, control, -np.ones(2), np.ones(2))[:rows]

    return Tangents(slacks, slopes)


def curved(u):
    return np.array([-1.0 - u[0] ** 2, -2.0 + u[0] * u[1]])


def test_after_two_secants_differences_are_made_anew_and_not_five_times():
    made, rng = [], np.random.default_rng(0)
    found = tangents(curved, made)
    rows = [found.about(u) for u in rng.uniform(-1.0, 1.0, (14, 2))]
    assert [r.provisional for r in rows[:12]] == [False, True, True] * 4
    assert len(made) == 4 and not rows[12].offsets.size and not rows[13].offsets.size


@given(first=arrays(float, 2, elements=numbers), second=arrays(float, 2, elements=numbers))
def test_a_secant_explains_the_change_and_leaves_other_directions_alone(first, second):
    step = second - first
    if np.linalg.norm(step) < 1e-2:
        return
    found = tangents(curved)
    before, after = -found.about(first).normals, -found.about(second).normals
    np.testing.assert_allclose(after @ step, curved(second) - curved(first), atol=1e-9)
    across = np.array([-step[1], step[0]])
    np.testing.assert_allclose(after @ across, before @ across, atol=1e-9)


def test_the_rows_pass_a_little_inside_of_where_the_slopes_say():
    u = np.array([0.2, -0.3])
    rows = tangents(lambda u: 3.0 * u - 1.0).about(u)
    np.testing.assert_allclose(rows.normals, -3.0 * np.eye(2), atol=1e-9)
    np.testing.assert_allclose(rows.offsets, -1.0 - 0.01 * (1.0 - 3.0 * u), atol=1e-9)
    corrected = tangents(lambda u: 3.0 * u - 1.0)
    corrected.about(np.array([-0.9, -0.9]))
    np.testing.assert_allclose(corrected.about(u).offsets, -1.0 - 0.1 * (1.0 - 3.0 * u), atol=1e-9)


def test_a_control_that_came_back_unchanged_ends_it():
    found, u = tangents(curved), np.array([0.1, 0.2])
    assert found.about(u).offsets.size and not found.about(u).offsets.size


@pytest.mark.parametrize("broken", ["not finite", "of others"])
def test_secants_that_say_nothing_are_differences_again(broken):
    def slacks(u):
        if broken == "not finite":
            return np.array([-1.0 if u[0] < 0.5 else -np.inf, -1.0])
        return np.array([0.2 - u[0], u[0] - 0.7])  # the slopes of the second are not asked for

    made = []
    found = tangents(slacks, made, rows=1 if broken == "of others" else None)
    with np.errstate(invalid="ignore"):
        for u in ([0.3, 0.0], [0.6, 0.0]) if broken == "not finite" else ([0.3, 0.0], [0.1, 0.0]):
            rows = found.about(np.array(u))
    assert len(made) == 2 and not rows.provisional
