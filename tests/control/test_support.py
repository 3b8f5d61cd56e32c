"""Support polygons and the rows on forces over them, against hulls by scipy and zero moment points by hand."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracles import support_margin

from safe_wrappers.control.legged.support import Plane, common_plane, support_rows
from safe_wrappers.errors import ConfigurationError

UP = np.array([0.0, 0.0, 1.0])
GROUND = Plane(np.zeros(3), UP, np.eye(3)[:2])
CORNERS = np.array([[0.2, 0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [0.2, -0.1, 0.0]])


def test_contacts_at_several_heights_have_no_common_plane():
    normals = np.tile(UP, (4, 1))
    stairs = CORNERS + np.array([0.0, 0.15, 0.15, 0.0])[:, None] * UP
    assert common_plane(stairs, normals) is None
    # A wall beside a floor is no common plane either.
    assert common_plane(CORNERS[:2], np.array([UP, [1.0, 0.0, 0.0]])) is None
    ridge = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])  # level with the mean of two normals, which differ
    assert common_plane(ridge, np.array([UP, [1.0, 0.0, 0.0]])) is None
    assert common_plane(ridge, np.array([UP, [math.sin(0.04), 0.0, math.cos(0.04)]])) is not None
    assert common_plane(np.zeros((0, 3)), np.zeros((0, 3))) is None
    # One inclined plane is: height alone does not decide.
    slope = np.array([-math.sin(0.3), 0.0, math.cos(0.3)])
    tilted = CORNERS @ np.array(
        [[math.cos(0.3), 0, math.sin(0.3)], [0, 1, 0], [-math.sin(0.3), 0, math.cos(0.3)]]
    )
    shared = common_plane(tilted, np.tile(slope, (4, 1)))
    assert shared is not None
    assert shared.normal == pytest.approx(slope)
    within = CORNERS + np.array([0.004, 0.0, 0.0, 0.0])[:, None] * UP
    assert common_plane(within, normals) is not None


@given(
    st.lists(st.floats(0.0, 10.0), min_size=5, max_size=5),
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=5, max_size=5),
    st.floats(0.0, 0.12),
    st.integers(0, 100),
)
def test_rows_on_the_forces_say_what_the_margin_says(pressures, sideways, inset, seed):
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-0.3, 0.3, (5, 2)), np.zeros((5, 1))], axis=1)
    forces = np.concatenate([np.array(sideways), np.array(pressures)[:, None]], axis=1)
    assume(sum(pressures) > 0.1)
    margin = support_margin(points, np.tile(UP, (5, 1)), forces) - inset
    excess = (support_rows(points, GROUND, inset) @ forces.ravel()).max()
    # In newtons times metres over newtons: the inside margin itself.
    if margin >= 0.0:
        assert -excess / sum(pressures) == pytest.approx(margin, abs=1e-9)
    else:
        assert excess > 0.0 or margin > -1e-12


def test_a_line_of_support_has_no_rows():
    assert support_rows(CORNERS[:2], GROUND, 0.05) is None
    assert support_rows(np.array([CORNERS[0], CORNERS[2], np.zeros(3)]), GROUND, 0.05) is None


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: support_rows(CORNERS, GROUND, math.nan), "inset"),
        (lambda: common_plane(np.zeros((2, 2)), np.zeros((2, 2))), "shape"),
    ],
)
def test_bad_input_is_refused(call, said):
    with pytest.raises(ConfigurationError, match=said):
        call()
