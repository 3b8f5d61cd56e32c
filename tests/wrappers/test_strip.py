"""The strip: what it says of a step, and where it says so on a frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers import info as keys
from safe_wrappers.wrappers.strip import STATES, STEPS, state_of, with_strip


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


@given(st.integers(1, 150), st.integers(1, 400))
def test_a_frame_of_any_size_keeps_its_shape(height, width):
    frame = np.zeros((height, width, 3), np.uint8)
    drawn = with_strip(frame, ["as proposed", "changed"])
    assert drawn.shape == frame.shape and not frame.any()
    assert (drawn[-1, -1] == STATES["changed"][0]).all() and not drawn[: -max(4, height // 24)].any()


@pytest.mark.parametrize("width", [40, 150, 901])
def test_columns_are_steps_in_the_colour_of_the_state_the_last_at_the_right(width):
    states = ["as proposed"] * 30 + ["changed"] * 40 + ["fallback"] * 20
    strip = with_strip(np.zeros((900, width, 3), np.uint8), states)[-37:]
    assert (strip == strip[0]).all()
    counted = [
        (strip[0] == STATES[state][0]).all(axis=-1) for state in ("as proposed", "changed", "fallback")
    ]
    assert [where.sum() * STEPS / width for where in counted] == pytest.approx(
        [30, 40, 20], abs=STEPS / width
    )
    proposed, changed, fallback = (np.flatnonzero(where) for where in counted)
    assert proposed.max() < changed.min() and changed.max() < fallback.min() and fallback.max() == width - 1
