"""Wave lines: whatever the network does, no more comes out than has arrived; what holding the last sample does."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.teleop import WaveLine
from safe_wrappers.errors import ConfigurationError

DT = 2.0**-10
# The square of a smaller one is no number of full precision any more.
WAVES = st.floats(-1e3, 1e3).map(lambda x: x if abs(x) > 1e-100 else 0.0)


@st.composite
def traffic(draw):
    """Waves of two components, and for each how many ticks later its copies arrive (none: lost)."""
    count = draw(st.integers(1, 25))
    waves = [np.array(draw(st.tuples(WAVES, WAVES))) for _ in range(count)]
    late = [draw(st.lists(st.integers(0, 12), max_size=2)) for _ in range(count)]
    return waves, late


def energy(wave):
    """J, exactly."""
    return sum((Fraction(float(x)) ** 2 for x in wave), Fraction(0)) / 2 * Fraction(DT)


def run(waves, late, declare_lost=True):
    """All ticks until the last packet has arrived and a little longer: the line and what it put out."""
    line, out = WaveLine(DT, components=2), []
    for tick in range(len(waves) + 15):
        if tick < len(waves):
            line.send(waves[tick], tick)
            if not late[tick] and declare_lost:
                line.lose(tick)
        arriving = [
            (k, waves[k]) for k, copies in enumerate(late) for d in copies if k <= tick and k + d == tick
        ]
        out.append(line.deliver(arriving))
        yield tick, line, out


def finished(waves, late):
    """The line at the end, and all that it put out, shape (ticks, 2)."""
    *_, (_, line, out) = run(waves, late)
    return line, np.array(out)


@given(traffic(), st.booleans())
def test_no_more_comes_out_than_has_arrived(given_traffic, declare_lost):
    waves, late = given_traffic
    for tick, line, out in run(waves, late, declare_lost):
        sent = sum((energy(w) for w in waves[: tick + 1]), Fraction(0))
        there = sum(
            (energy(w) for k, w in enumerate(waves) if late[k] and k + min(late[k]) <= tick), Fraction(0)
        )
        came_out = sum((energy(w) for w in out), Fraction(0))
        rounding = Fraction(1e-14) * (sent + Fraction(1e-300))
        assert came_out <= there + rounding
        assert line.put_out_j == pytest.approx(float(came_out), rel=1e-12)
        assert line.put_in_j == pytest.approx(float(sent), rel=1e-12)
        parts = line.put_out_j, line.in_flight_j, line.reserve_j, line.lost_j
        assert min(parts) >= 0.0
        assert sum(parts) == pytest.approx(line.put_in_j, rel=1e-12)
        assert line.put_out_j <= line.put_in_j - line.in_flight_j + float(rounding)
        gone = [k for k in range(min(tick + 1, len(waves))) if not late[k] or k + min(late[k]) > tick]
        expected = [energy(waves[k]) for k in gone if late[k] or not declare_lost]
        exact = float(sum(expected, Fraction(0)))
        assert line.in_flight_j == pytest.approx(exact, rel=1e-12, abs=1e-25 * float(sent))


@pytest.mark.parametrize("delay", [0, 1, 7])
def test_a_fixed_delay_is_a_fixed_delay_bit_for_bit(delay):
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(50, 2))
    line, out = finished(waves, [[delay]] * 50)
    np.testing.assert_array_equal(out[delay : delay + 50], waves)
    np.testing.assert_array_equal(out[:delay], np.zeros((delay, 2)))
    assert not np.any(out[delay + 50 :])
    assert (line.in_flight_j, line.lost_j, line.reserve_j) == (0.0, pytest.approx(0.0, abs=1e-15), 0.0)


def test_holding_the_last_sample_makes_energy_and_a_line_does_not():
    """One packet in four arrives; what a plain channel does is to repeat the last."""
    waves = [np.array([1.0, 0.0])] * 24
    late = [[0] if k % 4 == 0 else [] for k in range(24)]
    repeated, last = 0.0, np.zeros(2)
    for k, wave in enumerate(waves):
        last = wave if late[k] else last
        repeated += 0.5 * DT * float(last @ last)
    arrived = 6 * 0.5 * DT
    assert repeated == 4.0 * arrived
    line, _ = finished(waves, late)
    assert line.put_out_j == arrived


def test_the_queue_turns_jitter_into_the_delay_of_the_latest_packet():
    """Packets that keep their order: after the latest one a fixed delay, every wave out once."""
    rng = np.random.default_rng(1)
    waves = rng.normal(size=(400, 2))
    arrives = np.maximum.accumulate(np.arange(400) + rng.integers(2, 10, size=400))
    late = [[int(at - k)] for k, at in enumerate(arrives)]
    assert late[0] != [9]
    line, out = finished(waves, late)
    assert line.put_out_j == pytest.approx(line.put_in_j, rel=1e-12)
    np.testing.assert_allclose(out.sum(axis=0), waves.sum(axis=0), atol=1e-10)
    latest = late.index([9])
    assert latest < 100
    np.testing.assert_array_equal(out[latest + 9 : 409], waves[latest:])
    assert not np.array_equal(out[9 : latest + 9], waves[:latest])  # until then it was shorter


def test_a_packet_that_grew_on_the_way_pays_with_what_was_sent():
    line = WaveLine(DT)
    line.send(1.0, 0)
    assert float(line.deliver([(0, 50.0)])[0]) == pytest.approx(1.0)
    assert line.put_out_j <= line.put_in_j


def test_a_packet_that_was_never_sent_is_nothing():
    assert WaveLine(DT).deliver([(0, 1.0)]) == 0.0


def test_a_packet_that_was_written_off_comes_too_late():
    line = WaveLine(DT)
    line.send(1.0, 0)
    line.lose(0)
    assert line.lost_j == 0.5 * DT
    assert line.deliver([(0, 1.0)]) == 0.0


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: WaveLine(DT).send(math.nan, 0), "finite"),
        (lambda: WaveLine(DT).send(1e200, 0), "finite"),
        (lambda: WaveLine(DT).send("wave", 0), "number or an array"),
    ],
)
def test_what_cannot_be_worked_with_is_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()
