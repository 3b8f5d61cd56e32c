"""Seams against brute force: every blend is built one number at a time, and all lengths are tried."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from slow_handover import Slow, smooth

from safe_wrappers.control.handover import SeamCheck, SeamLimits, join

HOLD = 0.1


@st.composite
def seams(draw):
    """Random streams; numbers from a generator, so that ties are accidents."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m = draw(st.integers(1, 3))
    sent = rng.uniform(-1, 1, (draw(st.integers(1, 5)), m))
    prior = rng.uniform(-1, 1, (draw(st.integers(0, 8)), m))
    new = rng.uniform(-1, 1, (draw(st.integers(1, 9)), m))
    if draw(st.booleans()):  # streams that move slowly, with one jump between them
        sent, prior, new = (np.cumsum(0.05 * x, axis=0) for x in (sent, prior, new))
        new = new + draw(st.floats(-1, 1))
    fewest = draw(st.integers(0, 9))
    step = draw(st.one_of(st.just(math.inf), st.floats(1e-3, 2.0)))
    return sent, prior, new, fewest, step


@given(seams())
def test_the_shortest_blend_that_keeps_the_limit_by_brute_force(drawn):
    sent, prior, new, fewest, step = drawn
    slow = Slow(1.0, fewest, step, sent=sent.tolist())
    wanted = slow.shortest(prior.tolist(), new.tolist())
    assume(not slow.close_calls)
    plan, steps = join(sent, prior, new, step, fewest)
    assert steps == wanted[0]
    np.testing.assert_allclose(plan, np.array(wanted[1]), atol=1e-12)
    assert plan.shape == new.shape and plan[steps:].tobytes() == new[steps:].tobytes()


def test_nothing_to_blend_where_nothing_was_sent():
    new = np.array([[3.0], [3.2], [3.1]])
    plan, steps = join(np.zeros((0, 1)), np.zeros((0, 1)), new, 0.1, fewest=2)
    assert steps == 0 and plan.tobytes() == new.tobytes()


def test_a_left_over_is_never_padded():
    """Three commands left: a blend of three moves along them, one of four starts from the last command."""
    sent, prior, new = np.array([[0.0]]), np.array([[0.1], [0.2], [0.3]]), np.full((8, 1), 2.0)
    three, _ = join(sent, prior, new, fewest=3)
    alpha = np.array([smooth(i / 4) for i in (1, 2, 3)])
    np.testing.assert_allclose(three[:3, 0], (1 - alpha) * [0.1, 0.2, 0.3] + alpha * 2.0, atol=1e-15)
    four, _ = join(sent, prior, new, fewest=4)
    np.testing.assert_allclose(four[:4, 0], [2.0 * smooth(i / 5) for i in (1, 2, 3, 4)], atol=1e-15)


def bridged(sent, new, step, **limits):
    """By quintics, in a box of 100."""
    step, box = np.broadcast_to(step, new.shape[1:]), np.full(new.shape[1], 100.0)
    return SeamCheck(SeamLimits(**limits), new.shape[1], HOLD).join(sent, new, step, 0, -box, box)


@pytest.mark.parametrize("by", [lambda sent, new, step: join(sent, sent[:0], new, step), bridged])
def test_a_limit_for_each_component(by):
    """Two joints in different units: each keeps its own."""
    sent, new = np.zeros((3, 2)), np.tile([1.0, 100.0], (30, 1))
    step = HOLD * np.array([2.0, 200.0])
    plan, steps = by(sent, new, step)
    alone = [by(sent[:, k : k + 1], new[:, k : k + 1], step[k])[1] for k in (0, 1)]
    assert steps == max(alone) > 5
    assert (np.abs(np.diff(np.vstack([sent[-1:], plan]), axis=0)) <= step * (1 + 1e-12)).all()
    assert by(sent, new, np.array([step[0], 1e9]))[1] == steps  # the slow one decides


def test_without_a_bridge_that_keeps_the_step_there_is_none():
    sent, new = np.zeros((3, 1)), np.full((8, 1), 50.0)
    assert bridged(sent, new, 1.0) is None and bridged(sent, new, 20.0)[1] < 8
    assert bridged(sent, new, 20.0, velocity=190.0)[1] > bridged(sent, new, 20.0)[1]
