"""One held axis against a simulation of single physics steps, written here."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.backup import damped_axis as of

SPEEDS = st.floats(-7.0, 7.0).map(lambda v: round(v, 6))


@st.composite
def axes(draw):
    return of.damped_axis(
        decay=draw(st.floats(0.8, 1.0)),
        gain=draw(st.floats(0.01, 0.5)),
        timestep=draw(st.sampled_from([0.002, 0.01, 0.05])),
        substeps=draw(st.integers(1, 6)),
        low=draw(st.floats(-2.0, -0.2)),
        high=draw(st.floats(0.2, 2.0)),
        clip=draw(st.floats(1.0, 6.0)),
    )


@given(axes(), st.floats(-3.0, 3.0), SPEEDS, st.floats(-1.0, 1.0))
def test_a_hold_is_its_physics_steps(axis, x, v, u):
    v = of.clipped(axis, v)
    assert abs(v) <= axis.clip
    end, speed = x, v
    for _ in range(axis.substeps):
        speed = axis.decay * speed + axis.gain * np.clip(u, axis.low, axis.high)
        end += axis.timestep * speed
    assert of.step(axis, x, v, u) == pytest.approx((end, speed), abs=1e-12)


@given(axes(), SPEEDS)
def test_braking_is_full_until_a_hold_ends_at_rest_and_never_turns_back(axis, v):
    v = of.clipped(axis, v)
    for _ in range(5000):
        if abs(v) <= 1e-12:
            return
        u, (_, after) = of.brake(axis, v), of.step(axis, 0.0, v, of.brake(axis, v))
        assert np.sign(v) * after >= -1e-12
        assert u in (axis.low, axis.high) or abs(after) <= 1e-12
        v = after
    raise AssertionError("did not come to rest")
