"""Energy at a port: power by waves, lossless lines, and plain delays whose activity is known in closed form."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.teleop import ChannelLedger, effort_and_outgoing, to_waves

NUMBERS = st.floats(-1e4, 1e4, allow_subnormal=False)
IMPEDANCES = st.floats(1e-3, 1e4)


PORTS = st.integers(1, 4).flatmap(lambda m: st.tuples(*[st.tuples(*[NUMBERS] * m).map(np.array)] * 2))
"""Effort and flow."""


@given(PORTS, IMPEDANCES)
def test_waves_carry_the_ports_power_and_lead_back_to_it(port, b):
    f, v = port
    u, w = to_waves(f, v, b)
    scale = 1e-300 + float((f * f).sum() / b + b * (v * v).sum())  # of the roundings of a power, W
    assert abs(0.5 * (u @ u) - 0.5 * (w @ w) - f @ v) <= 1e-14 * scale
    near = 1e-14 * math.sqrt(scale)
    np.testing.assert_allclose(math.sqrt(b / 2.0) * (u + w), f, rtol=1e-12, atol=near * b**0.5)
    np.testing.assert_allclose((u - w) / math.sqrt(2.0 * b), v, rtol=1e-12, atol=near * b**-0.5)
    effort, outgoing = effort_and_outgoing(v, w, b)
    np.testing.assert_allclose(effort, f, rtol=1e-12, atol=near * b**0.5)
    np.testing.assert_allclose(outgoing, u, rtol=1e-12, atol=near)


@pytest.mark.parametrize("impedance", [20.0, -300.0j / 8.0, 2.0j * 8.0], ids=["damper", "spring", "mass"])
@pytest.mark.parametrize("phase", [0.0, 0.2, math.pi / 4, 3 * math.pi / 4])
def test_whether_a_plain_delay_is_active_depends_on_what_is_behind_it(impedance, phase):
    """Sines of 8 rad/s. At 45 degrees a spring makes it active and a mass does not, at 135 the reverse."""
    ledger, count = ChannelLedger(), 1000
    time_s = 10 * 2.0 * math.pi / 8.0 / count
    for n in range(count):
        late = lambda phase, n=n: 0.3 * np.exp(1j * (8.0 * n * time_s - phase))  # noqa: E731
        there, back = impedance * late(phase), impedance * late(2.0 * phase)
        ledger.add(back.real, late(0.0).real, there.real, late(phase).real, time_s)
    # P_s - P_m: V^2 / 2 (Re Z - Re(Z exp(-2 j phase)))
    made = 0.5 * 0.3**2 * (impedance - impedance * np.exp(-2j * phase)).real
    assert -ledger.net_j / (count * time_s) == pytest.approx(made, abs=1e-9)
    assert ledger.created_j >= max(made, 0.0) * count * time_s - 1e-9


@given(st.integers(1, 20), st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=60))
def test_a_lossless_line_holds_what_is_in_flight(delay, given_ports):
    """Whatever is done at its two ends: net energy in is the energy of the waves in flight, at every tick."""
    b, dt = 7.0, 1e-3
    up, down = ([np.zeros(1)] * delay for _ in range(2))
    ledger = ChannelLedger()
    for port in given_ports:
        flow_m, effort_s = np.array(port[:1]), np.array(port[1:])
        effort_m, u = effort_and_outgoing(flow_m, down.pop(0), b)
        arrived = up.pop(0)
        flow_s, w = (math.sqrt(2.0 * b) * arrived - effort_s) / b, math.sqrt(2.0 / b) * effort_s - arrived
        up.append(u)
        down.append(w)
        in_flight = 0.5 * dt * math.fsum(float(x @ x) for x in up + down)
        ledger.add(effort_m, flow_m, effort_s, flow_s, dt, stored_j=in_flight)
        assert ledger.net_j == pytest.approx(in_flight, rel=1e-9, abs=1e-9)
    assert ledger.created_j <= 1e-9 * (1.0 + in_flight)
