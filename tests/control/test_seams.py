"""Seams against brute force: every blend is built one number at a time, and all lengths are tried."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from safe_wrappers.control.handover import SeamCheck, SeamLimits, join

HOLD = 0.1


def smooth(s):
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


def slow_blend(sent, prior, new, n):
    """The first n + 1 commands of a blend of n steps for one component; the last of them is the new stream's."""
    made = []
    for i in range(n):
        before = prior[i] if n <= len(prior) else sent[-1]
        alpha = smooth((i + 1) / (n + 1))
        made.append((1.0 - alpha) * before + alpha * new[i])
    return [*made, new[n]]


def slow_join(sent, prior, new, fewest, step):
    """The plan, and the blend's steps: all lengths tried from the shortest on; None if a tie."""
    controls = len(new[0])
    fewest = min(fewest, len(new) - 1)
    if fewest == 0 and all(abs(new[0][k] - sent[-1][k]) <= step for k in range(controls)):
        return new, 0
    best = None
    for n in range(max(fewest, 1) if len(new) > 1 else 0, len(new)):
        columns = [
            slow_blend([c[k] for c in sent], [c[k] for c in prior], [c[k] for c in new], n)
            for k in range(controls)
        ]
        peak = max(
            abs(b - a)
            for k, column in enumerate(columns)
            for a, b in zip([sent[-1][k], *column], column, strict=False)
        )
        if math.isfinite(step) and abs(peak - step) < 1e-9:
            return None
        if best is None or (best[0] > step and peak < best[0] - 1e-12):
            best = peak, n, columns
        if peak <= step:
            break
    _, n, columns = best
    blended = [[column[i] for column in columns] for i in range(n)]
    return [*blended, *new[n:]], n


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
    wanted = slow_join(sent.tolist(), prior.tolist(), new.tolist(), fewest, step)
    assume(wanted is not None)
    plan, steps = join(sent, prior, new, step, fewest)
    assert steps == wanted[1]
    np.testing.assert_allclose(plan, np.array(wanted[0]), atol=1e-12)
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
