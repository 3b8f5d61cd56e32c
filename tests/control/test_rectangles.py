"""Joined rectangles against the area covered."""

from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.numerics.shapes import merged


def covers(r, p):
    return r[0] <= p[0] <= r[1] and r[2] <= p[1] <= r[3]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=25), st.floats(0.3, 2.0))
def test_merged_covers_the_same_cells_and_nothing_else(cells, size):
    squares = [(i * size, (i + 1) * size, j * size, (j + 1) * size) for i, j in cells]
    joined = merged(squares)
    assert len(joined) <= len(squares)
    for i in range(6):
        for j in range(6):
            centre = ((i + 0.5) * size, (j + 0.5) * size)
            assert any(covers(r, centre) for r in joined) == ((i, j) in cells)
