"""Passivity control: no more damping than needed, debts told, two ends far apart."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.teleop.passivity import ChannelLedger
from safe_wrappers.control.teleop.passivity_control import EnergyReference
from safe_wrappers.errors import ConfigurationError

DT = 1e-3
NUMBERS = st.floats(-100.0, 100.0).map(lambda x: round(x, 3))
PAIRS = st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=30)
CAUSALITIES = st.sampled_from(["impedance", "admittance"])


def test_a_flow_too_small_to_dissipate_anything():
    result = EnergyReference().modify(-1e300, 5e-324, 1.0)
    assert np.isfinite(result.effort).all()
    owed = EnergyReference()
    owed.modify(-1.0, 0.0, 1.0)
    result = owed.modify(0.0, 5e-324, 1.0, actual=1.0)
    assert (result.effort, result.correction, result.debt_j) == (0.0, 0.0, 1.0)


def test_both_causalities_are_mirror_images():
    rng = np.random.default_rng(0)
    one, other = EnergyReference("impedance", 0.2), EnergyReference("admittance", 0.2)
    for f, v in rng.normal(size=(50, 2, 3)):
        a, b = one.modify(f, v, 0.1), other.modify(v, f, 0.1)
        np.testing.assert_array_equal(a.effort, b.flow)
        np.testing.assert_array_equal(a.flow, b.effort)
        assert a[2:] == b[2:]


def network(rng, count):
    """Who hears which of the other end's messages at which tick: late, twice, out of order, or never."""
    heard = [[] for _ in range(count + 20)]
    for sent in range(count):
        for _ in range(int(rng.integers(0, 3))):
            heard[sent + int(rng.integers(0, 20))].append(sent)
    return heard


@given(st.integers(0, 2**32 - 1), PAIRS, CAUSALITIES, st.floats(0.0, 0.1))
def test_two_ends_never_give_more_than_they_took(seed, rows, causality, storage):
    rng = np.random.default_rng(seed)
    heard_m, heard_s = network(rng, len(rows)), network(rng, len(rows))
    m, s = EnergyReference(causality, storage), EnergyReference("impedance")
    sent_m, sent_s, took, scale = [], [], 0.0, storage
    for tick, row in enumerate(rows):
        m.receive(*(sent_s[k] for k in heard_m[tick] if k < len(sent_s)))
        s.receive(*(sent_m[k] for k in heard_s[tick] if k < len(sent_m)))
        at_m, at_s = m.modify(*row[:2], DT), s.modify(*row[2:], DT)
        took += float(at_m.effort @ at_m.flow + at_s.effort @ at_s.flow) * DT
        scale += sum(abs(a * b) for a, b in (row[:2], row[2:])) * DT
        assert took >= -storage - at_m.debt_j - at_s.debt_j - 1e-12 * scale
        for before, end in ((sent_m, m), (sent_s, s)):
            assert end.message_j >= (before[-1] if before else 0.0)
            before.append(end.message_j)


def test_an_end_without_debt_lets_through_bit_for_bit():
    end = EnergyReference(initial_storage_j=1.0)
    rng = np.random.default_rng(0)
    for f, v in rng.normal(size=(100, 2, 2)):
        result = end.modify(f, v, DT)
        np.testing.assert_array_equal(result.effort, f)
        np.testing.assert_array_equal(result.flow, v)


def test_energy_that_one_end_dissipated_is_not_told_to_the_other():
    end = EnergyReference()
    end.modify(-4.0, 1.0, 0.5)  # would give 2 J: damped to nothing
    paid = end.modify(3.0, 2.0, 0.5)
    assert (paid.effort, paid.correction) == (3.0, 0.0)
    assert end.message_j == 0.0
    end.modify(0.0, 0.0, 0.5)
    assert end.message_j == 3.0
    assert end.budget_j == 0.0


def test_what_comes_in_does_not_pay_a_debt_as_the_other_end_hears_of_it():
    end = EnergyReference(limit=1.6)
    assert end.modify(-4.0, 1.0, 0.5).debt_j == pytest.approx(1.2)  # 2 J less 0.8 J
    pays = end.modify(3.0, 2.0, 0.5)
    assert pays.correction == pytest.approx(1.2)
    assert pays.debt_j == 0.0
    end.modify(0.0, 0.0, 0.5)
    assert (end.message_j, end.budget_j) == (3.0, pytest.approx(0.0, abs=1e-15))


def test_an_end_that_is_only_accounted_damps_nothing_and_owes():
    end = EnergyReference("admittance", 0.5)
    end.account([2.0, 0.0], [3.0, 9.0], 0.5)
    assert (end.message_j, end.budget_j) == (3.0, 0.5)
    end.account(-2.0, 1.0, 0.5)
    assert (end.message_j, end.budget_j) == (3.0, -0.5)
    end.receive(2.0)
    assert end.budget_j == 1.5
    with pytest.raises(ConfigurationError, match="finite"):
        end.account(math.nan, 1.0, 0.5)
    assert end.budget_j == 1.5


def test_an_end_gives_what_it_has_heard_of():
    end = EnergyReference("admittance")
    end.receive(1.5, 1.0)
    end.receive(0.5)
    assert end.budget_j == 1.5
    free = end.modify(2.0, -1.0, 0.5)
    assert (free.flow, free.correction) == (-1.0, 0.0)
    held = end.modify(2.0, -1.0, 0.5)
    assert held.flow == pytest.approx(-0.5)  # 0.5 J are left of 1.5
    assert held.debt_j == 0.0


@pytest.mark.parametrize(("storage", "moves"), [(0.0, False), (0.01, True)])
def test_two_ends_need_some_storage_to_start(storage, moves):
    """A hand at constant speed, a mass behind a damper at the other end, no delay: nobody pays first."""
    m, s = EnergyReference(), EnergyReference("admittance", storage)
    x, v, felt = 0.0, 0.0, 0.0
    for _ in range(2000):
        m.receive(s.message_j)
        s.receive(m.message_j)
        m.modify(felt, 0.1, DT)
        flow = float(s.modify(-20.0 * (0.1 - v), 0.1, DT).flow[0])
        felt = 20.0 * (flow - v)
        v += felt * DT
        x += v * DT
    assert (x > 0.1) is moves


def test_a_delayed_spring_that_is_active_is_not_with_energy_references():
    """The plain channel of 45 degrees: it makes energy at every turn; with references it cannot."""
    omega, delay, stiffness = 8.0, 98, 300.0
    results = {}
    for control in (False, True):
        up, down, news_up, news_down = [0.0] * delay, [0.0] * delay, [0.0] * delay, [0.0] * delay
        m, s, ledger, x, debt = EnergyReference(), EnergyReference("admittance"), ChannelLedger(), 0.0, 0.0
        for n in range(6000):
            flow_m = 0.3 * math.cos(omega * n * DT)
            flow_s, effort_m = up.pop(0), down.pop(0)
            effort_s = stiffness * (x + 0.5 * flow_s * DT)
            if control:
                m.receive(news_down.pop(0))
                s.receive(news_up.pop(0))
                at_m = m.modify(effort_m, flow_m, DT)
                # Power into the channel: what the remote side does to it is minus what it does to the spring.
                at_s = s.modify(-effort_s, flow_s, DT)
                effort_m, flow_s = float(at_m.effort[0]), float(at_s.flow[0])
                news_up.append(m.message_j)
                news_down.append(s.message_j)
                debt = max(debt, at_m.debt_j + at_s.debt_j)
            x += flow_s * DT
            up.append(flow_m)
            down.append(effort_s)
            ledger.add(effort_m, flow_m, effort_s, flow_s, DT)
        results[control] = ledger.created_j, debt
    assert results[False][0] > 5.0
    assert results[True][0] <= results[True][1] + 1e-12
    assert results[True][1] < 0.01


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: EnergyReference("force"), "causality"),
        (lambda: EnergyReference(initial_storage_j=math.nan), "initial_storage_j"),
        (lambda: EnergyReference(initial_storage_j=-1.0), "initial_storage_j"),
        (lambda: EnergyReference(limit=0.0), "limit"),
        (lambda: EnergyReference().modify(1.0, [1.0, 2.0], DT), "of one size"),
        (lambda: EnergyReference().modify(math.nan, 1.0, DT), "finite"),
        (lambda: EnergyReference().modify(1.0, 1.0, -DT), "time_s"),
        (lambda: EnergyReference().receive(-1.0), "message_j"),
        (lambda: EnergyReference().receive(math.nan), "message_j"),
    ],
)
def test_what_cannot_be_worked_with_is_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()


def test_what_was_seen_must_fit_what_was_sampled():
    controller = EnergyReference()
    controller.modify([1.0, 1.0], [1.0, 1.0], DT)
    for bad in (1.0, [1.0], [1.0, 1.0, 1.0], [math.nan, 1.0]):
        with pytest.raises(ConfigurationError):
            controller.modify([1.0, 1.0], [1.0, 1.0], DT, actual=bad)
    controller.modify([1.0, 1.0], [1.0, 1.0], DT, actual=[1.0, 1.0])
