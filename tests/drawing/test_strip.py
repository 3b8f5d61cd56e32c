import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers import info as keys
from safe_wrappers.drawing import strip
from safe_wrappers.drawing.strip import STATES, Strip, state_of, words_of

LIGHT = np.full((200, 300, 3), 250, np.uint8)


def colours(frame, name):
    """Where a frame has the colour of a state."""
    return np.argwhere((np.abs(frame.astype(int) - STATES[name]) <= 2).all(axis=-1))


@pytest.mark.parametrize(
    ("info", "state"),
    [
        ({}, "as proposed"),
        ({keys.CBF_INTERVENED: True}, "changed"),
        ({keys.CBF_INTERVENED: True, keys.LEASE_BRAKING: True}, "braked"),
        ({keys.TELEOP_REVOKED: True}, "braked"),
        ({keys.CBF_INTERVENED: True, keys.CBF_FALLBACK: True}, "fallback"),
        ({keys.CBF_FALLBACK: True, keys.COST: 1.0}, "violation"),
        ({keys.COST: 0.0, keys.COST_SUBSTEP: 1.0}, "violation"),
    ],
)
def test_the_worst_of_what_a_step_reports_is_its_state(info, state):
    assert state_of(info) == state


def test_what_nobody_reports_is_not_said():
    assert words_of({}) == []
    assert words_of({keys.CBF_MARGIN: 0.0}) == []  # written where no constraint has an h
    info = {
        keys.CBF_MARGIN: -0.25,
        keys.LEASE_REMAINING_S: 0.5,
        keys.TELEOP_ROUND_TRIP_S: 0.125,
        keys.SLIP_RATIO: np.array([0.1, -0.3]),
    }
    assert words_of(info) == ["margin -0.25", "lease 0.50 s", "round trip 0.12 s", "slip 0.30"]


def test_only_the_lower_edge_of_a_copy_is_drawn_on():
    shown = Strip()
    shown.begin({})
    before = LIGHT.copy()
    frame = shown.on(before)
    np.testing.assert_array_equal(before, LIGHT)
    assert frame.shape == LIGHT.shape and frame.dtype == np.uint8
    top = 200 - round(0.14 * 200)
    np.testing.assert_array_equal(frame[:top], LIGHT[:top])
    assert (frame[top:] != LIGHT[top:]).any(axis=2).mean() > 0.9


@given(st.integers(1, 150), st.integers(1, 400), st.booleans())
def test_a_frame_of_any_size_keeps_its_shape(height, width, bounded):
    shown = Strip(np.array([-1.0]), np.array([1.0])) if bounded else Strip()
    shown.begin({})
    shown.add({keys.EXECUTED_ACTION: np.array([0.5]), keys.PROPOSED_ACTION: np.array([1.0])})
    frame = np.zeros((height, width, 3), np.uint8)
    drawn = shown.on(frame)
    assert drawn.shape == frame.shape and drawn.any() == (min(height, width) >= 60)


def test_every_step_is_a_column_the_last_at_the_right():
    shown = Strip()
    shown.begin({})
    for state in ("changed", "fallback"):
        for _ in range(20):
            shown.add({keys.CBF_INTERVENED: state == "changed", keys.CBF_FALLBACK: state == "fallback"})
    wide = np.full((400, 900, 3), 250, np.uint8)
    frame = shown.on(wide)[-20:]  # below the words
    changed, fallback = colours(frame, "changed")[:, 1], colours(frame, "fallback")[:, 1]
    assert changed.max() < fallback.min() < fallback.max() >= 885
    assert fallback.max() - changed.min() == pytest.approx(40 * 900 / strip.STEPS, abs=12)
    shown.begin({})
    assert not len(colours(shown.on(wide)[-20:], "changed"))


def test_columns_are_as_high_as_the_margin():
    shown = Strip()
    shown.begin({})
    for margin in (2.0, 1.0, 0.5):
        for _ in range(30):
            shown.add({keys.CBF_MARGIN: margin, keys.CBF_INTERVENED: True})
    places = colours(shown.on(np.zeros((900, 900, 3), np.uint8))[-62:], "changed")
    heights = [(places[:, 1] == x).sum() for x in (895 - 6 * 75, 895 - 6 * 45, 895 - 6 * 15)]
    assert heights[0] == pytest.approx(2 * heights[1], abs=3) == pytest.approx(4 * heights[2], abs=7)


def test_bars_reach_from_zero_to_the_action_proposed_beside_executed():
    shown = Strip(np.array([-1.0]), np.array([1.0]))
    shown.begin({})
    assert shown._actions() == (None, None)
    shown.add({keys.PROPOSED_ACTION: np.array([1.0]), keys.EXECUTED_ACTION: np.array([-1.0])})
    frame = shown.on(np.zeros((400, 600, 3), np.uint8)).astype(int)
    found = {}
    for role in ("proposed", "executed"):
        found[role] = np.argwhere((np.abs(frame - strip.colour_of(role)) <= 2).all(axis=-1))
    (up_y, up_x), (down_y, down_x) = (found[r].mean(axis=0) for r in ("proposed", "executed"))
    assert up_x < down_x and up_y < down_y
    assert found["proposed"][:, 0].max() <= found["executed"][:, 0].min() + 3


def test_without_a_filter_the_executed_action_alone_has_a_bar():
    shown = Strip(np.array([-1.0]), np.array([1.0]))
    shown.add({keys.EXECUTED_ACTION: np.array([1.0])})
    frame = shown.on(np.zeros((400, 600, 3), np.uint8)).astype(int)
    seen = [
        (np.abs(frame - strip.colour_of(role)) <= 2).all(axis=-1).any() for role in ("proposed", "executed")
    ]
    assert seen == [False, True]
