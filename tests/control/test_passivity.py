"""Energy at a port: power by waves, and channels measured with sines."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.teleop import (
    ChannelLedger,
    effort_and_outgoing,
    to_waves,
)
from safe_wrappers.errors import ConfigurationError

NUMBERS = st.floats(-1e4, 1e4, allow_subnormal=False)
VECTORS = st.lists(NUMBERS, min_size=1, max_size=4)
IMPEDANCES = st.floats(1e-3, 1e4)


@st.composite
def ports(draw):
    effort = draw(VECTORS)
    return np.array(effort), np.array(draw(st.lists(NUMBERS, min_size=len(effort), max_size=len(effort))))


def size_of(f, v, b):
    """Scale of the roundings of a power, W."""
    return 1e-300 + float((f * f).sum() / b + b * (v * v).sum())


@given(ports(), IMPEDANCES)
def test_waves_carry_the_ports_power(port, b):
    f, v = port
    u, w = to_waves(f, v, b)
    scale = size_of(f, v, b)
    assert abs(0.5 * (u @ u) - 0.5 * (w @ w) - f @ v) <= 1e-14 * scale


@given(ports(), IMPEDANCES)
def test_every_way_through_the_transform_ends_at_the_same_port(port, b):
    f, v = port
    u, w = to_waves(f, v, b)
    near = {"rtol": 1e-12, "atol": 1e-14 * math.sqrt(size_of(f, v, b))}
    efforts, flows, waves = ({**near, "atol": near["atol"] * s} for s in (b**0.5, b**-0.5, 1.0))
    np.testing.assert_allclose(math.sqrt(b / 2.0) * (u + w), f, **efforts)
    np.testing.assert_allclose((u - w) / math.sqrt(2.0 * b), v, **flows)
    effort, outgoing = effort_and_outgoing(v, w, b)
    np.testing.assert_allclose(effort, f, **efforts)
    np.testing.assert_allclose(outgoing, u, **waves)


class Behind:
    """What is connected at the remote port: a damper, a spring or a mass; flow in, effort back."""

    def __init__(self, kind):
        self.kind, self.x, self.v = kind, 0.0, 0.0

    def effort(self, flow, dt):
        """Mean effort over an interval of constant flow (of constant effort, for the mass)."""
        if self.kind == "damper":
            return 20.0 * flow
        if self.kind == "spring":
            self.x += flow * dt
            return 300.0 * (self.x - 0.5 * flow * dt)
        before, self.v = self.v, flow
        return 2.0 * (flow - before) / dt


def remote_side(effort, u, b):
    """Its flow and the wave that it sends back, from its effort and the wave that arrived."""
    return (math.sqrt(2.0 * b) * u - effort) / b, math.sqrt(2.0 / b) * effort - u


def measured(kind, phase, coding):
    """Mean power that the channel makes of a sine, W: a one-way delay with that phase, after the first periods."""
    dt, omega = 1e-3, 8.0
    delay = round(phase / omega / dt)
    omega = phase / (delay * dt) if delay else omega
    period = 2.0 * math.pi / omega
    up, down, impedance = [0.0] * delay, [0.0] * delay, 20.0
    remote, net, flow_s, effort_s = Behind(kind), 0.0, 0.0, 0.0
    first, last = round(10 * period / dt), round(20 * period / dt)
    ledger = ChannelLedger()
    for n in range(last):
        flow_m = 0.3 * math.cos(omega * n * dt)
        if coding == "plain":
            up.append(flow_m)
            flow_s = up.pop(0)
            effort_s = remote.effort(flow_s, dt)
            down.append(effort_s)
            effort_m = down.pop(0)
        else:
            # An operator who gives way as the line does, so that the sines settle.
            u = 0.3 * math.cos(omega * n * dt)
            back = down.pop(0)
            effort_m = math.sqrt(impedance / 2.0) * (u + back)
            flow_m = (u - back) / math.sqrt(2.0 * impedance)
            up.append(float(u))
            # The spring's effort follows from the flow that follows from it: solved, not one step late.
            u_s = up.pop(0)
            half = 0.5 * 300.0 * dt
            stretch = 300.0 * remote.x
            root = math.sqrt(2.0 * impedance)
            flow_s = (root * u_s - stretch) / (impedance + half)
            effort_s = remote.effort(flow_s, dt)
            again, w = remote_side(effort_s, u_s, impedance)
            assert again == pytest.approx(flow_s)
            down.append(float(w))
        ledger.add(effort_m, flow_m, effort_s, flow_s, dt)
        if n + 1 == first:
            net = ledger.net_j
    return (net - ledger.net_j) / ((last - first) * dt), ledger


QUARTER = math.pi / 4


@pytest.mark.parametrize(
    ("kind", "phase", "active"),
    [
        ("damper", 0.2, True),
        ("damper", QUARTER, True),
        ("damper", 3 * QUARTER, True),
        ("spring", QUARTER, True),
        ("spring", 3 * QUARTER, False),
        ("mass", QUARTER, False),
        ("mass", 3 * QUARTER, True),
    ],
)
def test_whether_a_plain_delay_is_active_depends_on_what_is_behind_it(kind, phase, active):
    """No phase is a threshold: at 45 degrees a spring makes it active and a mass does not, at 135 the reverse."""
    made, ledger = measured(kind, phase, "plain")
    # P_m - P_s of sines: V^2 / 2 (Re(Z exp(-2 j phase)) - Re Z)
    omega = phase / (round(phase / 8.0 / 1e-3) * 1e-3)
    impedance = {"damper": 20.0, "spring": -300.0j / omega, "mass": 2.0j * omega}[kind]
    expected = -0.5 * 0.3**2 * ((impedance * np.exp(-2j * phase)).real - impedance.real)
    assert made == pytest.approx(expected, rel=0.05)
    assert (made > 0.0) is active
    assert not active or ledger.created_j > 1e-6


@pytest.mark.parametrize("phase", [0.2, QUARTER, 3 * QUARTER])
def test_with_waves_the_same_sines_make_nothing(phase):
    made, ledger = measured("spring", phase, "wave")
    assert abs(made) < 1e-3 * 0.5 * 0.3**2  # of the wave's power
    assert ledger.created_j < 1e-12


@given(st.integers(1, 20), st.lists(ports(), min_size=1, max_size=60))
def test_a_lossless_line_holds_what_is_in_flight(delay, given_ports):
    """Whatever is done at its two ends: net energy in is the energy of the waves in flight, at every tick."""
    b, dt = 7.0, 1e-3
    up, down = ([np.zeros(1)] * delay for _ in range(2))
    ledger = ChannelLedger()
    for port in given_ports:
        flow_m, effort_s = port[0][:1], port[1][:1]
        effort_m, u = effort_and_outgoing(flow_m, down.pop(0), b)
        flow_s, w = remote_side(effort_s, up.pop(0), b)
        up.append(u)
        down.append(w)
        in_flight = 0.5 * dt * math.fsum(float(x @ x) for x in up + down)
        ledger.add(effort_m, flow_m, effort_s, flow_s, dt, stored_j=in_flight)
        assert ledger.net_j == pytest.approx(in_flight, rel=1e-9, abs=1e-9)
    assert ledger.created_j <= 1e-9 * (1.0 + in_flight)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: to_waves(1.0, 1.0, 0.0), "impedance must be a finite number > 0"),
        (lambda: to_waves(1.0, 1.0, math.nan), "impedance"),
        (lambda: to_waves([1.0, math.inf], [1.0, 1.0], 1.0), "effort must be finite"),
        (lambda: ChannelLedger().add([1.0], [1.0], [1.0, 2.0], [1.0], 1.0), "one shape"),
        (lambda: ChannelLedger().add(math.inf, 1.0, 0.0, 0.0, 1.0), "finite"),
    ],
)
def test_what_cannot_be_worked_with_is_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()
