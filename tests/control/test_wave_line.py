"""Wave lines: whatever the network does, no more comes out than has arrived; what holding the last sample does."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.teleop.wave_line import WaveLine
from safe_wrappers.errors import ConfigurationError

DT = 2.0**-10
RULES = ("queue", "hold", "zero")
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


def run(rule, waves, late, declare_lost=True):
    """All ticks until the last packet has arrived and a little longer: the line and what it put out."""
    line, out = WaveLine(DT, rule, components=2), []
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


def finished(rule, waves, late):
    """The line at the end, and all that it put out, shape (ticks, 2)."""
    *_, (_, line, out) = run(rule, waves, late)
    return line, np.array(out)


@given(st.sampled_from(RULES), traffic(), st.booleans())
def test_no_more_comes_out_than_has_arrived(rule, given_traffic, declare_lost):
    waves, late = given_traffic
    for tick, line, out in run(rule, waves, late, declare_lost):
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


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("delay", [0, 1, 7])
def test_a_fixed_delay_is_a_fixed_delay_bit_for_bit(rule, delay):
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(50, 2))
    line, out = finished(rule, waves, [[delay]] * 50)
    np.testing.assert_array_equal(out[delay : delay + 50], waves)
    np.testing.assert_array_equal(out[:delay], np.zeros((delay, 2)))
    if rule != "hold":
        assert not np.any(out[delay + 50 :])
    assert (line.in_flight_j, line.lost_j, line.reserve_j) == (0.0, pytest.approx(0.0, abs=1e-15), 0.0)


def test_holding_the_last_sample_makes_energy_and_no_rule_does():
    """One packet in four arrives; what a plain channel does is to repeat the last."""
    waves = [np.array([1.0, 0.0])] * 24
    late = [[0] if k % 4 == 0 else [] for k in range(24)]
    repeated, last = 0.0, np.zeros(2)
    for k, wave in enumerate(waves):
        last = wave if late[k] else last
        repeated += 0.5 * DT * float(last @ last)
    arrived = 6 * 0.5 * DT
    assert repeated == 4.0 * arrived
    for rule in RULES:
        line, _ = finished(rule, waves, late)
        assert 0.99 * arrived <= line.put_out_j <= arrived


def test_the_queue_turns_jitter_into_the_delay_of_the_latest_packet():
    """Packets that keep their order: after the latest one a fixed delay, every wave out once."""
    rng = np.random.default_rng(1)
    waves = rng.normal(size=(400, 2))
    arrives = np.maximum.accumulate(np.arange(400) + rng.integers(2, 10, size=400))
    late = [[int(at - k)] for k, at in enumerate(arrives)]
    assert late[0] != [9]
    line, out = finished("queue", waves, late)
    assert line.put_out_j == pytest.approx(line.put_in_j, rel=1e-12)
    np.testing.assert_allclose(out.sum(axis=0), waves.sum(axis=0), atol=1e-10)
    latest = late.index([9])
    assert latest < 100
    np.testing.assert_array_equal(out[latest + 9 : 409], waves[latest:])
    assert not np.array_equal(out[9 : latest + 9], waves[:latest])  # until then it was shorter


def test_hold_is_paid_from_what_came_in_surplus():
    line = WaveLine(DT, "hold")
    for sequence in range(4):
        line.send(2.0, sequence)
    assert line.deliver([]) == 0.0  # nothing held yet
    assert line.deliver([(0, 2.0), (2, 2.0), (1, 2.0)]) == 2.0
    assert line.reserve_j == pytest.approx(2 * 2.0 * DT)
    assert line.deliver([]) == 2.0
    assert line.deliver([]) == 2.0
    assert line.deliver([]) == 0.0  # used up
    assert line.deliver([(3, 2.0)]) == 2.0


def test_hold_takes_the_newest_and_an_older_one_pays_only():
    line = WaveLine(DT, "hold", components=2)
    line.send([1.0, 0.0], 5)
    line.send([0.0, 3.0], 6)
    np.testing.assert_array_equal(line.deliver([(6, [0.0, 3.0])]), [0.0, 3.0])
    late = line.deliver([(5, [1.0, 0.0])])
    np.testing.assert_allclose(late, [0.0, 1.0])  # the newest, made as small as the energy of the older
    assert late @ late <= 1.0


def test_zero_adds_what_comes_at_once_and_scales_it_to_its_energy():
    line = WaveLine(DT, "zero")
    for sequence, wave in enumerate((3.0, 4.0, 2.0, -2.0)):
        line.send(wave, sequence)
    both = float(line.deliver([(0, 3.0), (1, 4.0)])[0])
    assert both == pytest.approx(5.0)  # 7 would carry 49, and 25 arrived
    assert both**2 <= 25.0
    assert line.deliver([(2, 2.0), (3, -2.0)]) == 0.0
    assert line.lost_j == pytest.approx(0.5 * DT * 8.0)


def test_a_packet_that_grew_on_the_way_pays_with_what_was_sent():
    for rule in RULES:
        line = WaveLine(DT, rule)
        line.send(1.0, 0)
        assert float(line.deliver([(0, 50.0)])[0]) == pytest.approx(1.0)
        assert line.put_out_j <= line.put_in_j


def test_a_packet_that_was_written_off_comes_too_late():
    line = WaveLine(DT, "queue")
    line.send(1.0, 0)
    line.lose(0)
    assert line.lost_j == 0.5 * DT
    assert line.deliver([(0, 1.0)]) == 0.0
    with pytest.raises(ConfigurationError, match="packet 0 is not in flight"):
        line.lose(0)


def test_what_is_returned_may_be_written_on():
    line = WaveLine(DT, "hold")
    line.send(1.0, 0)
    line.send(1.0, 1)
    line.deliver([(0, 1.0), (1, 1.0)])[:] = 7.0
    assert line.deliver([]) == 1.0


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: WaveLine(0.0), "time_s"),
        (lambda: WaveLine(DT, "last"), "rule must be one of queue, hold, zero, got 'last'"),
        (lambda: WaveLine(DT, components=0), "components"),
        (lambda: WaveLine(DT).send(math.nan, 0), "finite"),
        (lambda: WaveLine(DT).send(1e200, 0), "finite"),
        (lambda: WaveLine(DT).send([1.0, 2.0], 0), "a wave of 1 components, got 2"),
        (lambda: WaveLine(DT).send("wave", 0), "number or an array"),
        (lambda: WaveLine(DT).send(1.0, -1), "at least 0"),
        (lambda: WaveLine(DT).deliver([(0, 1.0)]), r"packets \[0\] arrived and were never sent"),
        (lambda: WaveLine(DT).lose(0), "not in flight"),
    ],
)
def test_what_cannot_be_worked_with_is_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()


def test_a_refused_delivery_changes_nothing():
    line = WaveLine(DT)
    line.send(1.0, 0)
    line.send(2.0, 1)
    with pytest.raises(ConfigurationError, match="finite"):
        line.deliver([(0, 1.0), (1, math.nan)])
    with pytest.raises(ConfigurationError, match="rise"):
        line.send(1.0, 1)
    assert line.in_flight_j == line.put_in_j == pytest.approx(0.5 * DT * 5.0)
