"""The strip: what it says of a step, and where it says so on a frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers import info as keys
from safe_wrappers.wrappers.strip import ACTIONS, STATES, STEPS, state_of, with_strip

ONE = np.array([-1.0]), np.array([1.0])


def places(frame, colour):
    """Where a frame has a colour: rows and columns."""
    return np.argwhere((frame == colour).all(axis=-1)).T


def test_the_worst_of_what_a_step_reports_is_its_state():
    assert state_of({}) == state_of({keys.COST: 0.0}) == "as proposed"
    info = {}
    for key, state in (
        (keys.CBF_INTERVENED, "changed"),
        (keys.LEASE_BRAKING, "braked"),
        (keys.CBF_FALLBACK, "fallback"),
        (keys.COST_SUBSTEP, "violation"),
    ):
        info[key] = True
        assert state_of(info) == state
    assert state_of({keys.TELEOP_REVOKED: True}) == "braked" and state_of({keys.COST: 1.0}) == "violation"


@given(st.integers(1, 150), st.integers(1, 400), st.sampled_from([None, ONE]), st.sampled_from([0.0, np.nan]))
def test_a_frame_of_any_size_keeps_its_shape(height, width, bounds, margin):
    info = {
        keys.EXECUTED_ACTION: np.array([0.5]),
        keys.PROPOSED_ACTION: np.array([1.0]),
        keys.CBF_MARGIN: margin,
    }
    frame = np.zeros((height, width, 3), np.uint8)
    drawn = with_strip(frame, [{}, info], bounds)
    assert drawn.shape == frame.shape and drawn.any() == (min(height, width) >= 60) and not frame.any()


def test_columns_are_steps_the_last_at_the_right_as_high_as_the_margin_in_the_colour_of_the_state():
    margins = [2.0] * 30 + [1.0] * 30 + [0.5] * 10
    infos = [{keys.CBF_MARGIN: margin, keys.CBF_INTERVENED: True} for margin in margins]
    infos += [{keys.CBF_MARGIN: -0.5, keys.CBF_FALLBACK: True}] * 20
    frame = with_strip(np.zeros((900, 900, 3), np.uint8), infos, None)[-62:]  # below the words
    changed, fallback = (places(frame, STATES[state][0])[1] for state in ("changed", "fallback"))
    assert changed.max() < fallback.min() < fallback.max() >= 875
    assert fallback.max() - changed.min() == pytest.approx(90 * 900 / STEPS, abs=20)
    high, half, quarter = ((changed == 880 - round(5.8 * age)).sum() for age in (75, 45, 25))
    assert 40 < high == pytest.approx(2 * half, abs=3) == pytest.approx(4 * quarter, abs=7)


def test_bars_reach_from_zero_to_the_action_proposed_beside_executed():
    info = {keys.PROPOSED_ACTION: np.array([1.0]), keys.EXECUTED_ACTION: np.array([-1.0])}
    frame = with_strip(np.zeros((400, 600, 3), np.uint8), [info], ONE)
    (up, left), (down, right) = (places(frame, colour) for colour in ACTIONS.values())
    assert left.max() < right.min() and up.min() < up.max() <= down.min() + 3 < down.max()
