"""ChunkQueue alone: which command is next, with chunks that are late, out of order, broken, refused or missing."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.wrappers.chunk_queue import ChunkQueue

HOLD = 0.1


def queue(
    blend="replace", fewest=0, limit=math.inf, controls=1, decay=0.0, low=-1e3, high=1e3, dtype=np.float64
):
    space = gym.spaces.Box(low, high, (controls,), dtype)
    return ChunkQueue(
        space, HOLD, blend=blend, fewest=fewest, rate_limit=np.full(controls, limit), decay=decay
    )


def numbered(k, size):
    """Entry j of chunk k is 100 k + j."""
    return 100.0 * k + np.arange(size, dtype=np.float64)[:, None]


def fallback():
    return np.array([-1.0])


def never():
    raise AssertionError("the fallback was asked, though commands are planned")


def tick(queue, stand_in=fallback, admit=lambda commands: True):
    """One command."""
    return queue.next(admit, stand_in)


def run(queue, ticks, *how, **admit):
    return [tick(queue, *how, **admit) for _ in range(ticks)]


def controls(commands):
    return [float(c.control[0]) for c in commands]


def test_entries_are_consumed_by_their_age():
    q = queue()
    assert q.submit(numbered(1, 5), observed=0, due=2)
    commands = run(q, 7)
    assert controls(commands) == [-1, -1, 102, 103, 104, -1, -1]
    assert [c.starved for c in commands] == [True, True, False, False, False, True, True]
    assert [c.took_over for c in commands] == [False, False, True, False, False, False, False]
    assert [c.observed for c in commands] == [-1, -1, 0, 0, 0, 0, 0]
    assert [c.seam for c in commands] == [False, False, True, False, False, True, False]


def test_the_fallback_is_not_asked_while_there_are_commands():
    q = queue()
    q.submit(numbered(1, 3), 0, 0)
    run(q, 3, never)


@given(
    st.lists(st.tuples(st.integers(0, 4), st.integers(0, 6), st.integers(1, 6)), min_size=1, max_size=8),
    st.randoms(use_true_random=False),
)
def test_whatever_the_order_of_arrival_the_newest_observation_that_is_there_counts(chunks, random):
    """Chunks are observed one after another and arrive at any time; brute force over all that have arrived."""
    q, observed, known = queue(), -1, []
    submissions = {}
    for k, (gap, late, size) in enumerate(chunks):
        observed += gap + 1
        submissions[observed] = (k, size, observed + late)
    for t in range(observed + 15):
        if t in submissions:
            k, size, due = submissions[t]
            assert q.submit(numbered(k, size), t, due)
            known.append((t, k, size, due))
        command = tick(q)
        # In force is the newest that has arrived in time to have an entry left when it came.
        best = None
        for seen, k, size, due in known:
            if due <= t and due - seen < size and (best is None or seen > best[0]):
                best = (seen, k, size)
        expected = -1.0 if best is None or t - best[0] >= best[2] else 100.0 * best[1] + t - best[0]
        assert float(command.control[0]) == expected
        assert command.starved == (expected == -1.0)


def test_a_chunk_that_was_overtaken_never_takes_over():
    q = queue()
    q.submit(numbered(1, 9), 0, 4)
    run(q, 2)
    q.submit(numbered(2, 9), 2, 2)
    commands = run(q, 9)
    assert controls(commands) == [200 + j for j in range(9)]
    assert not any(c.refused for c in commands), "it is overtaken, not refused"


def test_one_that_comes_too_late_is_refused_and_the_left_over_goes_on():
    q = queue()
    q.submit(numbered(1, 6), 0, 0)
    run(q, 1)
    q.submit(numbered(2, 2), 1, 4)
    commands = run(q, 5)
    assert controls(commands) == [101, 102, 103, 104, 105]
    assert [c.refused for c in commands] == [False, False, False, True, False]
    assert not any(c.took_over or c.seam for c in commands)


@pytest.mark.parametrize("observed", [0, -1, -7, 2, 3, 99])
def test_repeats_and_chunks_from_the_future_are_refused(observed):
    q = queue()
    q.submit(numbered(1, 4), 0, 0)
    run(q, 1)
    assert not q.submit(numbered(2, 4), observed, 1)
    assert controls(run(q, 3, never)) == [101, 102, 103]


def test_one_on_its_way_counts_as_heard_of():
    q = queue()
    run(q, 5)
    assert q.submit(numbered(1, 9), 3, 8)
    assert not q.submit(numbered(2, 9), 3, 5) and not q.submit(numbered(2, 9), 2, 5)
    assert q.submit(numbered(3, 9), 4, 5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("blend", ["replace", "ensemble", "smoothstep", "quintic", "hermite"])
def test_one_entry_that_is_not_finite_refuses_the_chunk(blend, bad):
    q = queue(blend, fewest=2)
    for where in range(6):
        chunk = numbered(1, 6)
        chunk[where] = bad
        assert not q.submit(chunk, 0, 0)
    assert q.submit(numbered(2, 6), 0, 0), "a refused chunk does not make its observation old"
    assert controls(run(q, 6, never)) == [200 + j for j in range(6)]


def test_an_older_chunk_steps_in_for_a_newer_one_that_is_refused():
    q = queue()
    q.submit(numbered(1, 9), 0, 2)
    run(q, 1)
    q.submit(numbered(2, 9), 1, 2)
    run(q, 1)
    command = tick(q, never, lambda commands: commands[-1, 0] < 200)
    assert (
        float(command.control[0]) == 102 and command.refused and command.took_over and command.observed == 0
    )


def test_admission_is_asked_with_the_end_and_the_time_to_it():
    asked = []

    def admit(commands):
        end, steps = commands[-1], len(commands)
        asked.append((end.tolist(), steps))
        return end[0] < 150

    q = queue()
    q.submit(numbered(1, 5), 0, 2)
    run(q, 3, admit=admit)
    q.submit(numbered(2, 5), 3, 3)
    commands = run(q, 3, admit=admit)
    assert asked == [([104.0], 3), ([204.0], 5)]
    assert [c.refused for c in commands] == [True, False, False]
    assert controls(commands) == [103, 104, -1]


def test_a_refused_chunk_may_be_asked_for_again():
    q = queue()
    q.submit(numbered(1, 5), 0, 0)
    assert run(q, 1, admit=lambda commands: False)[0].refused
    q.submit(numbered(2, 5), 0, 1)
    assert controls(run(q, 1, admit=lambda commands: True)) == [201]


@given(st.integers(0, 2**32 - 1), st.floats(0, 3), st.integers(1, 3))
def test_the_ensemble_by_its_formula(seed, decay, m):
    rng = np.random.default_rng(seed)
    q, known = queue("ensemble", controls=m, decay=decay), []
    for t in range(30):
        if rng.random() < 0.5:
            chunk, due = rng.uniform(-1, 1, (int(rng.integers(1, 8)), m)), t + int(rng.integers(0, 4))
            q.submit(chunk, t, due)
            known.append((t, due, chunk))
        command = tick(q, lambda: np.full(m, 7.0))
        used = [(seen, due, chunk) for seen, due, chunk in known if due <= t and due - seen < len(chunk)]
        # A chunk that arrives after a newer one that could be used has been overtaken.
        used = [u for u in used if not any(v[0] > u[0] and v[1] < u[1] for v in used)]
        votes = [chunk[t - seen] for seen, _, chunk in used if t - seen < len(chunk)]
        if not votes:
            assert command.starved and (command.control == 7.0).all()
            continue
        weights = [math.exp(-decay * i) for i in range(len(votes))]
        mean = sum(w * v for w, v in zip(weights, votes, strict=True)) / sum(weights)
        np.testing.assert_allclose(command.control, mean, atol=1e-12)


def test_one_voice_is_executed_bit_for_bit():
    q = queue("ensemble", decay=0.3)
    chunk = np.random.default_rng(0).uniform(-1, 1, (5, 1))
    q.submit(chunk, 0, 0)
    assert np.array(controls(run(q, 5, never))).tobytes() == chunk.tobytes()


@pytest.mark.parametrize("blend", ["smoothstep", "quintic", "hermite"])
def test_commands_stay_in_the_box_and_the_limit_whatever_the_fallback_does(blend):
    rng = np.random.default_rng(0)
    q = queue(blend, limit=1.0, low=-0.5, high=0.5, dtype=np.float32)
    sent = []
    for t in range(200):
        if rng.random() < 0.2:
            q.submit(rng.uniform(-3, 3, (4, 1)), t, t + int(rng.integers(0, 3)))
        sent.append(tick(q, lambda: rng.choice([-1e30, 1e30], 1)).control)
    sent = np.array(sent)
    assert sent.dtype == np.float32 and np.abs(sent).max() == 0.5
    assert np.abs(np.diff(sent.astype(np.float64), axis=0)).max() <= 0.1


def test_rounding_to_the_dtype_is_not_called_holding_back():
    """A blend that just keeps the limit, in numbers that float32 has to round: kept, and nothing is reported."""
    rng = np.random.default_rng(0)
    alpha = np.array([10 * s**3 - 15 * s**4 + 6 * s**5 for s in np.arange(6) / 5])
    rounded_over = 0
    for _ in range(50):
        a, b = rng.uniform(-1, 1, 2).astype(np.float32).astype(np.float64)
        exact = a + alpha * (b - a)
        limit = np.abs(np.diff(exact)).max() / HOLD * (1 + 1e-14)
        q = queue("smoothstep", limit=limit, dtype=np.float32)
        q.submit(np.full((2, 1), a), 0, 0)
        run(q, 1)
        q.submit(np.full((9, 1), b), 1, 1)
        commands = run(q, 9, never)
        assert commands[0].blend_steps == 4 and not any(c.limited for c in commands)
        sent = np.array([a, *controls(commands)])
        assert np.abs(np.diff(sent)).max() <= limit * HOLD
        rounded_over += np.abs(np.diff(exact.astype(np.float32).astype(np.float64))).max() > limit * HOLD
    assert rounded_over > 5, "else this shows nothing"


def test_a_difference_divided_by_the_interval_is_never_above_the_limit():
    rng = np.random.default_rng(0)
    limits = rng.uniform(0.1, 5.0, 300)
    assert any(limit * HOLD / HOLD > limit for limit in limits), "else this shows nothing"
    for limit in limits:
        q = queue("smoothstep", limit=float(limit))
        q.submit(np.array([[0.0], [50.0]]), 0, 0)
        first, second = controls(run(q, 2, never))
        assert (second - first) / HOLD <= limit and second - first >= limit * HOLD * (1 - 1e-15)


def test_a_fade_ends_on_a_target_that_moves():
    """Into a fallback that goes on moving: latched start, weights of the smoothstep, then the fallback itself."""
    q, step = queue("smoothstep", fewest=4), itertools.count()
    q.submit(np.array([[5.0]]), 0, 0)
    run(q, 1)
    commands = run(q, 7, lambda: np.array([0.1 * next(step)]))
    alpha = [10 * s**3 - 15 * s**4 + 6 * s**5 for s in (0.2, 0.4, 0.6, 0.8)] + [1.0] * 3
    expected = [5.0 + a * (0.1 * i - 5.0) for i, a in enumerate(alpha)]
    np.testing.assert_allclose(controls(commands), expected, atol=1e-12)
    assert [c.blend_steps for c in commands] == [4] + [0] * 6
    assert [c.seam for c in commands] == [True] + [False] * 6
    assert controls(commands)[4:] == [0.1 * i for i in (4, 5, 6)]


def test_a_fade_is_as_long_as_the_way_inside_the_box():
    q = queue("smoothstep", limit=1.875, low=-0.5, high=0.5)
    q.submit(np.array([[-0.5]]), 0, 0)
    run(q, 1)
    into = run(q, 10, lambda: np.array([1e30]))
    assert into[0].blend_steps == 9, "1 unit at 1.875 per second: a second, ten control steps"
    assert controls(into)[-1] == 0.5 and not any(c.limited for c in into)


def test_coming_back_in_the_middle_of_a_fade_starts_from_where_it_is():
    q = queue("smoothstep", fewest=4)
    q.submit(np.array([[1.0]]), 0, 0)
    at = float(run(q, 3, lambda: np.array([0.0]))[-1].control[0])
    assert 0.0 < at < 1.0
    q.submit(np.array([[1.0]]), 3, 3)
    back = run(q, 1, never)[0]
    alpha = 10 * 0.2**3 - 15 * 0.2**4 + 6 * 0.2**5
    assert float(back.control[0]) == pytest.approx(at + alpha * (1.0 - at), abs=1e-12)
    assert back.blend_steps == 4 and back.seam


def test_a_long_chunk_ends_a_fade():
    """A chunk that takes over while the queue fades into the fallback: one blend, its own."""
    q = queue("smoothstep", fewest=4)
    q.submit(np.full((1, 1), 1.0), 0, 0)
    at = float(run(q, 2, lambda: np.array([0.0]))[-1].control[0])
    q.submit(np.full((9, 1), 1.0), 2, 2)
    commands = run(q, 9, never)
    alpha = [10 * s**3 - 15 * s**4 + 6 * s**5 for s in (0.2, 0.4, 0.6, 0.8)] + [1.0] * 5
    np.testing.assert_allclose(controls(commands), [at + a * (1 - at) for a in alpha], atol=1e-12)


def test_a_reset_keeps_the_source_and_nothing_else():
    q = queue("smoothstep", fewest=4)
    q.switch("human")
    q.submit(np.array([[1.0]]), 0, 0)
    q.submit(np.array([[1.0]]), 0, 9)
    run(q, 2)
    q.reset()
    assert q.now == 0
    first = run(q, 1)[0]
    assert (first.observed, first.starved, first.seam, first.blend_steps) == (-1, True, False, 0)
    assert float(first.control[0]) == -1.0
