import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers import info as keys
from safe_wrappers.drawing import scene as strip
from safe_wrappers.drawing.scene import STATES, Strip, state_of


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
