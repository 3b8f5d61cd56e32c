"""One held axis against a simulation of single physics steps, written here, and against the undamped formula."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.backup import damped_axis as of

SPEEDS = st.floats(-7.0, 7.0).map(lambda v: round(v, 6))
PLACES = st.floats(-3.0, 3.0)
CONTROLS = st.floats(-1.0, 1.0)


@st.composite
def axes(draw, clip=True):
    return of.damped_axis(
        decay=draw(st.floats(0.8, 1.0)),
        gain=draw(st.floats(0.01, 0.5)),
        timestep=draw(st.sampled_from([0.002, 0.01, 0.05])),
        substeps=draw(st.integers(1, 6)),
        low=draw(st.floats(-2.0, -0.2)),
        high=draw(st.floats(0.2, 2.0)),
        clip=draw(st.one_of(st.just(math.inf), st.floats(1.0, 6.0))) if clip else math.inf,
    )


def simulated(axis, x, v, u):
    """Every physics step of one hold: positions and speeds, the start included."""
    v = min(max(v, -axis.clip), axis.clip)
    u = min(max(u, axis.low), axis.high)
    xs, vs = [x], [v]
    for _ in range(axis.substeps):
        v = axis.decay * v + axis.gain * u
        x = x + axis.timestep * v
        xs.append(x)
        vs.append(v)
    return xs, vs


def braked(axis, x, v):
    """Every physics step of the manoeuvre until rest, asked for anew at every hold."""
    xs, vs = [x], [v]
    for _ in range(5000):
        if abs(vs[-1]) <= 1e-12:
            return xs, vs
        more_x, more_v = simulated(axis, xs[-1], vs[-1], of.brake(axis, vs[-1]))
        xs += more_x[1:]
        vs += more_v[1:]
    raise AssertionError("did not come to rest")


@given(axes(), PLACES, SPEEDS, CONTROLS)
def test_a_hold_is_its_physics_steps(axis, x, v, u):
    v = of.clipped(axis, v)
    xs, vs = simulated(axis, x, v, u)
    assert of.step(axis, x, v, u) == pytest.approx((xs[-1], vs[-1]), abs=1e-12)
    assert of.extent(axis, x, v, u) == pytest.approx((min(xs), max(xs)), abs=1e-12)


@given(axes(), PLACES, SPEEDS)
def test_braking_ends_where_it_says_and_never_turns_back(axis, x, v):
    xs, vs = braked(axis, x, v)
    assert of.rest(axis, x, v) == pytest.approx(xs[-1], abs=1e-9)
    assert (np.sign(v) * np.array(vs) >= -1e-12).all()
    ends = of.braking(axis, x, v)
    assert ends[0] == x and ends[-1] == pytest.approx(xs[-1], abs=1e-9)
    # At a whole number of holds rounding decides whether one more, of next to nothing, ends at rest.
    path = [*xs[:: axis.substeps], xs[-1]]
    assert ends == pytest.approx(path[: len(ends)], abs=1e-9)


@given(axes(), PLACES, SPEEDS)
def test_after_one_hold_of_braking_the_rest_point_is_the_same(axis, x, v):
    end = of.step(axis, x, of.clipped(axis, v), of.brake(axis, v))
    assert of.rest(axis, *end) == pytest.approx(of.rest(axis, x, v), abs=1e-9)


@given(axes(), PLACES, SPEEDS, st.floats(0.0, 1.0))
def test_the_control_to_rest_at_a_target_does(axis, x, v, share):
    v = of.clipped(axis, v)
    target = of.rest(axis, *of.step(axis, x, v, axis.low + share * (axis.high - axis.low)))
    u = of.control_to_rest_at(axis, x, v, target)
    assert axis.low - 1e-6 <= u <= axis.high + 1e-6
    assert of.rest(axis, *of.step(axis, x, v, u)) == pytest.approx(target, abs=1e-9)


@given(axes(), PLACES, SPEEDS, CONTROLS, CONTROLS)
def test_more_control_never_rests_or_reaches_less_far(axis, x, v, a, b):
    v, (a, b) = of.clipped(axis, v), sorted((a, b))
    assert of.rest(axis, *of.step(axis, x, v, a)) <= of.rest(axis, *of.step(axis, x, v, b)) + 1e-12
    low, high = of.extent(axis, x, v, a), of.extent(axis, x, v, b)
    assert low[0] <= high[0] + 1e-12 and low[1] <= high[1] + 1e-12
