"""Seams against brute force: every blend is built one number at a time, and all lengths are tried."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from safe_wrappers.control.handover import BLENDS, join, limit_rate

HOLD = 0.1
blends = pytest.mark.parametrize("blend", BLENDS)


def smooth(s):
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


def slow_blend(blend, sent, prior, new, n, low=-math.inf, high=math.inf):
    """The first n + 1 commands of a blend of n steps for one component; the last of them is the new stream's."""
    if blend == "smoothstep":
        moves = n <= len(prior)
        made = []
        for i in range(n):
            before = prior[i] if moves else sent[-1]
            alpha = smooth((i + 1) / (n + 1))
            made.append((1.0 - alpha) * before + alpha * new[i])
        return [*made, new[n]]
    rate = sent[-1] - sent[-2] if len(sent) > 1 else 0.0
    second = sent[-1] - 2.0 * sent[-2] + sent[-3] if len(sent) > 2 else 0.0
    last = len(new) - 1
    if last == 0:
        slope, bend = 0.0, 0.0
    elif 0 < n < last:
        slope, bend = (new[n + 1] - new[n - 1]) / 2.0, new[n + 1] - 2.0 * new[n] + new[n - 1]
    else:
        slope, bend = (new[1] - new[0] if n == 0 else new[n] - new[n - 1]), 0.0
    ends = [[sent[-1], rate, second], [new[n], slope, bend]]
    bridge = BPoly.from_derivatives([0.0, n + 1.0], ends)
    return [min(max(float(bridge(i + 1.0)), low), high) for i in range(n)] + [new[n]]


def slow_join(blend, sent, prior, new, fewest, step, low=-math.inf, high=math.inf):
    """Plan before holding back, and the blend's steps: all lengths tried from the shortest on; None if a tie."""
    controls = len(new[0])
    fewest = min(fewest, len(new) - 1)
    if fewest == 0 and all(abs(new[0][k] - sent[-1][k]) <= step for k in range(controls)):
        return new, 0
    best = None
    for n in range(max(fewest, 1) if len(new) > 1 else 0, len(new)):
        columns = [
            slow_blend(blend, [c[k] for c in sent], [c[k] for c in prior], [c[k] for c in new], n, low, high)
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


@blends
@given(seams(), st.booleans())
def test_the_shortest_blend_that_keeps_the_limit_by_brute_force(blend, drawn, boxed):
    sent, prior, new, fewest, step = drawn
    low, high = (-0.9, 0.8) if boxed else (-math.inf, math.inf)
    if boxed:
        sent, prior, new = (np.clip(x, low, high) for x in (sent, prior, new))
    wanted = slow_join(
        blend, sent.tolist(), prior.tolist(), new.tolist(), fewest, step / HOLD * HOLD, low, high
    )
    assume(wanted is not None)
    plan, steps = wanted
    found = join(
        sent, prior, new, HOLD, blend=blend, fewest=fewest, rate_limit=step / HOLD, low=low, high=high
    )
    assert found.steps == steps
    free = ~np.logical_or.accumulate(found.limited)  # what comes before anything was held back
    np.testing.assert_allclose(found.plan[free], np.array(plan)[free], atol=1e-12)
    after = free & (np.arange(len(new)) >= steps)
    assert found.plan[after].tobytes() == new[after].tobytes()
    assert np.abs(np.diff(np.vstack([sent[-1:], found.plan]), axis=0)).max() <= step * (1 + 1e-12)
    assert found.plan.shape == new.shape and found.limited.shape == (len(new),)
    if boxed:
        assert found.plan.min() >= low - 1e-12 and found.plan.max() <= high + 1e-12


@blends
@given(seams())
def test_held_back_only_where_the_blend_or_the_stream_itself_is_too_fast(blend, drawn):
    sent, prior, new, fewest, step = drawn
    wanted = slow_join(blend, sent.tolist(), prior.tolist(), new.tolist(), fewest, step / HOLD * HOLD)
    assume(wanted is not None)
    last, plan = sent[-1], np.array(wanted[0])
    for i, found in enumerate(
        join(sent, prior, new, HOLD, blend=blend, fewest=fewest, rate_limit=step / HOLD).limited
    ):
        excess = np.abs(plan[i] - last).max() - step
        assume(not abs(excess) < 1e-9)
        assert found == (excess > 0)
        last = np.clip(plan[i], last - step, last + step)


@blends
def test_nothing_to_blend_where_nothing_was_sent(blend):
    new = np.array([[3.0], [3.2], [3.1]])
    seam = join(np.zeros((0, 1)), np.zeros((0, 1)), new, HOLD, blend=blend, fewest=2, rate_limit=2.5)
    assert seam.steps == 0 and seam.plan.tobytes() == new.tobytes() and not seam.limited.any()


@blends
def test_a_chunk_too_fast_by_itself_is_held_back_from_its_own_first_command(blend):
    new = np.array([[0.0], [1.0], [1.0], [1.0]])
    seam = join(np.zeros((0, 1)), np.zeros((0, 1)), new, HOLD, blend=blend, rate_limit=4.0)
    np.testing.assert_allclose(seam.plan[:, 0], [0.0, 0.4, 0.8, 1.0])
    assert seam.limited.tolist() == [False, True, True, False]


def test_a_left_over_is_never_padded():
    """Three commands left: a blend of three moves along them, one of four starts from the last command."""
    sent, prior, new = np.array([[0.0]]), np.array([[0.1], [0.2], [0.3]]), np.full((8, 1), 2.0)
    three = join(sent, prior, new, HOLD, fewest=3)
    alpha = np.array([smooth(i / 4) for i in (1, 2, 3)])
    np.testing.assert_allclose(three.plan[:3, 0], (1 - alpha) * [0.1, 0.2, 0.3] + alpha * 2.0, atol=1e-15)
    four = join(sent, prior, new, HOLD, fewest=4)
    np.testing.assert_allclose(four.plan[:4, 0], [2.0 * smooth(i / 5) for i in (1, 2, 3, 4)], atol=1e-15)


@blends
def test_a_limit_for_each_component(blend):
    """Two joints in different units: each keeps its own."""
    sent, new = np.zeros((3, 2)), np.tile([1.0, 100.0], (30, 1))
    limits = np.array([2.0, 200.0])
    seam = join(sent, np.zeros((0, 2)), new, HOLD, blend=blend, rate_limit=limits)
    alone = [
        join(sent[:, k : k + 1], np.zeros((0, 1)), new[:, k : k + 1], HOLD, blend=blend, rate_limit=limits[k])
        for k in (0, 1)
    ]
    assert seam.steps == max(a.steps for a in alone) > 5
    steps = np.abs(np.diff(np.vstack([sent[-1:], seam.plan]), axis=0)).max(axis=0)
    assert (steps <= limits * HOLD * (1 + 1e-12)).all() and not seam.limited.any()
    uneven = join(sent, np.zeros((0, 2)), new, HOLD, blend=blend, rate_limit=np.array([2.0, 1e9]))
    assert uneven.steps == seam.steps  # the slow one decides


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 3), st.floats(1e-3, 3), st.booleans())
def test_limit_rate_is_a_chase_at_limited_speed(seed, n, m, step, started):
    rng = np.random.default_rng(seed)
    commands = rng.uniform(-1, 1, (n, m))
    before = rng.uniform(-1, 1, m) if started else None
    given_bytes = commands.tobytes()
    kept, limited = limit_rate(commands, before, step)
    assert commands.tobytes() == given_bytes
    for k in range(m):
        at = commands[0, k] if before is None else before[k]
        for i in range(n):
            at += max(-step, min(step, commands[i, k] - at))
            assert kept[i, k] == pytest.approx(at, abs=1e-12)
            if not limited[: i + 1].any():
                assert kept[i].tobytes() == commands[i].tobytes()
    fits = np.abs(np.diff(commands if before is None else np.vstack([before, commands]), axis=0))
    assert limited.any() == bool((fits > step).any())
