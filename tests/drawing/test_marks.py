import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safe_wrappers.drawing import marks

numbers = st.floats(-5.0, 5.0)
points = arrays(float, 3, elements=numbers)
sizes = st.floats(0.01, 5.0)


def ends(mark):
    """Of a rod, by its own axes; a box has two more numbers across."""
    way = mark.size[2 if mark.shape == "box" else 1] * mark.axes[:, 2]
    return mark.position - way, mark.position + way


@given(points, points)
def test_a_rod_goes_from_its_start_to_its_end_in_a_right_handed_frame(start, end):
    rod = marks.segment("way", start, end, 0.1)
    tail, tip = ends(rod)
    np.testing.assert_allclose(tail + tip, start + end, atol=1e-9)
    if np.linalg.norm(end - start) > 1e-9:
        np.testing.assert_allclose(tip, end, atol=1e-9)
    np.testing.assert_allclose(rod.axes.T @ rod.axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(rod.axes) == pytest.approx(1.0) and rod.size[0] == 0.1


@given(arrays(float, 2, elements=numbers), sizes)
def test_a_ring_lies_on_the_floor_around_its_centre(center, radius):
    drawn = marks.ring("limit", center, radius)
    for rod, after in zip(drawn, [*drawn[1:], drawn[0]], strict=True):
        tail, tip = ends(rod)
        assert np.hypot(*(tail[:2] - center)) == pytest.approx(radius)
        np.testing.assert_allclose(tip, ends(after)[0], atol=1e-9)
        assert tail[2] == marks.FLOOR


def test_the_edges_of_a_box_are_twelve_and_meet_in_threes():
    low, high = np.array([0.0, -1.0, 2.0]), np.array([1.0, 1.0, 5.0])
    drawn = marks.edges("limit", low, high, 0.01)
    assert sorted(2.0 * rod.size[1] for rod in drawn) == pytest.approx([1.0] * 4 + [2.0] * 4 + [3.0] * 4)
    corners = [tuple(np.round(end, 9)) for rod in drawn for end in ends(rod)]
    assert len(set(corners)) == 8 and all(corners.count(corner) == 3 for corner in corners)
