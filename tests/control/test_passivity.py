"""Energy at a port: closed forms of springs, masses and dampers, power by waves, and channels measured with sines."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.appendix.teleop.energy_ledger import EnergyLedger
from safe_wrappers.appendix.teleop.waves import flow_and_outgoing, from_waves, port_power, wave_power
from safe_wrappers.control.teleop.passivity import (
    ChannelLedger,
    effort_and_outgoing,
    to_waves,
)
from safe_wrappers.control.teleop.port_checks import RunningSum
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
    assert abs(wave_power(u, w) - port_power(f, v)) <= 1e-14 * scale
    assert abs(0.5 * (u @ u) - 0.5 * (w @ w) - f @ v) <= 1e-14 * scale  # the appendix's own form


@given(ports(), IMPEDANCES)
def test_every_way_through_the_transform_ends_at_the_same_port(port, b):
    f, v = port
    u, w = to_waves(f, v, b)
    near = {"rtol": 1e-12, "atol": 1e-14 * math.sqrt(size_of(f, v, b))}
    efforts, flows, waves = ({**near, "atol": near["atol"] * s} for s in (b**0.5, b**-0.5, 1.0))
    again = from_waves(u, w, b)
    np.testing.assert_allclose(again.effort, f, **efforts)
    np.testing.assert_allclose(again.flow, v, **flows)
    operator = effort_and_outgoing(v, w, b)
    np.testing.assert_allclose(operator.effort, f, **efforts)
    np.testing.assert_allclose(operator.outgoing, u, **waves)
    remote = flow_and_outgoing(f, u, b)
    np.testing.assert_allclose(remote.flow, v, **flows)
    np.testing.assert_allclose(remote.outgoing, w, **waves)


def test_waves_by_hand():
    u, w = to_waves(4.0, 1.0, 2.0)
    assert (u, w) == (3.0, 1.0)  # (4 + 2) / 2 and (4 - 2) / 2
    assert wave_power(u, w) == port_power(4.0, 1.0) == 4.0
    batch = to_waves(np.full((5, 2), 4.0), np.full((5, 2), 1.0), 2.0)
    assert batch.u.shape == (5, 2)
    assert port_power(np.full((5, 2), 4.0), np.full((5, 2), 1.0)).tolist() == [8.0] * 5


DT = 0.01


class Machine:
    """m x'' + c x' + k x = F, from rest under a constant force: everything in closed form."""

    m, c, k, force = 2.0, 1.5, 50.0, 3.0

    def __init__(self):
        self.decay = self.c / (2.0 * self.m)
        self.swing = math.sqrt(self.k / self.m - self.decay**2)

    def position(self, t):
        s, w = self.decay, self.swing
        return self.force / self.k * (1.0 - math.exp(-s * t) * (math.cos(w * t) + s / w * math.sin(w * t)))

    def speed(self, t):
        return self.force / (self.m * self.swing) * math.exp(-self.decay * t) * math.sin(self.swing * t)

    def stored(self, t):
        return 0.5 * self.m * self.speed(t) ** 2 + 0.5 * self.k * self.position(t) ** 2

    def heat(self, t):
        """c times the integral of the squared speed, integrated by hand."""
        s, w = self.decay, self.swing
        fading = (1.0 - math.exp(-2.0 * s * t)) / (4.0 * s)
        turning = (s + math.exp(-2.0 * s * t) * (w * math.sin(2.0 * w * t) - s * math.cos(2.0 * w * t))) / (
            4.0 * (s * s + w * w)
        )
        return self.c * (self.force / (self.m * w)) ** 2 * (fading - turning)


def test_a_mass_a_spring_and_a_damper_balance():
    machine, ledger, dt = Machine(), EnergyLedger(), 0.01
    for n in range(500):
        moved = machine.position((n + 1) * dt) - machine.position(n * dt)
        heat = machine.heat((n + 1) * dt) - machine.heat(n * dt)
        ledger.add(machine.force, moved / dt, dt, machine.stored((n + 1) * dt), heat)
        inside = machine.stored((n + 1) * dt)
        assert ledger.extractable_j == pytest.approx(inside, abs=1e-13)
    assert ledger.absorbed_j == pytest.approx(machine.force * machine.position(5.0), abs=1e-14)
    assert ledger.dissipated_j == pytest.approx(machine.heat(5.0), abs=1e-14)
    assert ledger.dissipated_j > 0.05  # of 0.19 J: the damper counts
    assert ledger.created_j < 1e-14
    assert ledger.extracted_j == 0.0


def test_a_hidden_source_shows_once_storage_or_heat_are_told():
    # The same machine with a motor that puts back what the damper takes: the port alone does not show it at once.
    told, heat_told, blind = EnergyLedger(), EnergyLedger(), EnergyLedger()
    machine, dt = Machine(), 0.01
    for n in range(500):
        moved = machine.position((n + 1) * dt) - machine.position(n * dt)
        heat = machine.heat((n + 1) * dt) - machine.heat(n * dt)
        motor = 1.25 * machine.heat((n + 1) * dt)
        blind.add(machine.force, moved / dt, dt)
        told.add(machine.force, moved / dt, dt, machine.stored((n + 1) * dt) + motor, heat)
        heat_told.add(machine.force, moved / dt, dt, dissipated_j=5.0 * heat)
    assert blind.passive
    assert not told.passive
    assert told.created_j == pytest.approx(1.25 * machine.heat(5.0), rel=1e-9)
    assert not heat_told.passive


def test_a_loaded_spring_gives_back_its_storage_and_no_more_than_that_is_passive():
    k, dt, n = 400.0, 1e-3, 100
    x = 0.1 * np.cos(np.linspace(0.0, math.pi / 2, n + 1))  # unloaded from 0.1 m to 0
    stored = 0.5 * k * x**2
    honest, too_little = EnergyLedger(stored[0]), EnergyLedger(1.5)
    for a, b, after in zip(x[:-1], x[1:], stored[1:], strict=True):
        for ledger in (honest, too_little):
            ledger.add(k * 0.5 * (a + b), (b - a) / dt, dt, after)
    assert honest.passive
    assert honest.extracted_j == pytest.approx(2.0)
    assert honest.extractable_j == pytest.approx(0.0, abs=1e-14)
    assert not too_little.passive
    assert too_little.created_j == pytest.approx(0.5)


def test_what_was_taken_out_once_stays_known():
    ledger = EnergyLedger(1.0)
    ledger.add([0.0, 2.0], [5.0, -1.0], 0.25)
    ledger.add([0.0, 2.0], [5.0, 3.0], 1.0)
    assert (ledger.absorbed_j, ledger.extracted_j, ledger.passive) == (5.5, 0.5, True)
    assert ledger.extractable_j == 6.5


def test_a_million_steps_do_not_drift():
    values = np.random.default_rng(0).normal(size=1_000_000) * 10.0 ** np.arange(-8, 2).repeat(100_000)
    values[::1000] += 1e9
    values[1::1000] -= 1e9
    total = RunningSum(1.0)
    for value in values.tolist():
        total.add(value)
    exact, size = math.fsum([1.0, *values.tolist()]), float(np.abs(values).sum())
    eps = np.finfo(float).eps
    bound = 2.0 * eps * abs(exact) + values.size * eps**2 * size
    assert abs(total.value - exact) <= bound
    assert abs(sum(values.tolist(), 1.0) - exact) > 1e3 * bound  # which adding up one by one is far from


def test_rounding_is_not_activity():
    rng, by_rounding = np.random.default_rng(0), 0
    for _ in range(100):
        ledger, pieces = EnergyLedger(), rng.uniform(0.1, 1.0, size=7)
        for piece in pieces:
            ledger.add(piece, 0.3, DT)
        ledger.add(-math.fsum(pieces.tolist()), 0.3, DT)
        by_rounding += ledger.extracted_j > 0.0
        assert ledger.passive
        assert ledger.extracted_j <= ledger.rounding_j < 1e-14
        ledger.add(-1e-9, 0.3, DT)
        assert not ledger.passive
    assert by_rounding > 5


def test_rounding_of_a_channel_is_not_activity():
    rng, by_rounding = np.random.default_rng(0), 0
    for _ in range(100):
        ledger, pieces = ChannelLedger(), rng.uniform(0.1, 1.0, size=7)
        for piece in pieces:
            ledger.add(piece, 0.3, 0.0, 0.0, DT)
        ledger.add(0.0, 0.0, math.fsum(pieces.tolist()), 0.3, DT)
        by_rounding += ledger.created_j > 0.0
        assert ledger.passive
        ledger.add(0.0, 0.0, 1e-9, 0.3, DT)
        assert not ledger.passive
    assert by_rounding > 5
    stored = ChannelLedger(0.7)
    stored.add(0.1, 0.3, 0.0, 0.0, 1.0, stored_j=0.73)  # 0.7 + 0.03 is a rounding below 0.73
    assert stored.passive


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
            effort_m, flow_m = from_waves(u, down.pop(0), impedance)
            up.append(float(u))
            # The spring's effort follows from the flow that follows from it: solved, not one step late.
            u_s = up.pop(0)
            half = 0.5 * 300.0 * dt
            stretch = 300.0 * remote.x
            root = math.sqrt(2.0 * impedance)
            flow_s = (root * u_s - stretch) / (impedance + half)
            effort_s = remote.effort(flow_s, dt)
            again, w = flow_and_outgoing(effort_s, u_s, impedance)
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
    assert not (active and ledger.passive)


@pytest.mark.parametrize("phase", [0.2, QUARTER, 3 * QUARTER])
def test_with_waves_the_same_sines_make_nothing(phase):
    made, ledger = measured("spring", phase, "wave")
    assert abs(made) < 1e-3 * 0.5 * 0.3**2  # of the wave's power
    assert ledger.passive
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
        flow_s, w = flow_and_outgoing(effort_s, up.pop(0), b)
        up.append(u)
        down.append(w)
        in_flight = 0.5 * dt * math.fsum(float(x @ x) for x in up + down)
        ledger.add(effort_m, flow_m, effort_s, flow_s, dt, stored_j=in_flight)
        assert ledger.stored_j == pytest.approx(in_flight, rel=1e-9, abs=1e-9)
    assert ledger.created_j <= 1e-9 * (1.0 + in_flight)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: to_waves(1.0, 1.0, 0.0), "impedance must be a finite number above 0"),
        (lambda: to_waves(1.0, 1.0, math.nan), "impedance"),
        (lambda: from_waves(1.0, 1.0, -2.0), "impedance"),
        (lambda: to_waves([1.0, 2.0], 1.0, 1.0), "of one shape"),
        (lambda: to_waves([1.0, math.inf], [1.0, 1.0], 1.0), "effort must be finite"),
        (lambda: port_power("push", 1.0), "effort is a number or an array"),
        (lambda: flow_and_outgoing(1.0, math.nan, 1.0), "incoming must be finite"),
        (lambda: EnergyLedger(-1.0), "initial_storage_j must be a finite energy"),
        (lambda: EnergyLedger(math.inf), "initial_storage_j"),
        (lambda: ChannelLedger(math.nan), "initial_storage_j"),
        (lambda: EnergyLedger().add(1.0, 1.0, 0.0), "time_s"),
        (lambda: EnergyLedger().add(1.0, math.nan, 1.0), "must be finite"),
        (lambda: EnergyLedger().add(1e200, 1e200, 1.0), "so their product"),
        (lambda: EnergyLedger().add([1.0, 2.0], [1.0], 1.0), "of one size"),
        (lambda: EnergyLedger().add(np.ones((2, 2)), np.ones((2, 2)), 1.0), "shape"),
        (lambda: EnergyLedger().add([], [], 1.0), "shape"),
        (lambda: EnergyLedger().add("push", 1.0, 1.0), "number or an array"),
        (lambda: EnergyLedger().add(1.0, 1.0, 1.0, stored_j=-1.0), "stored_j"),
        (lambda: EnergyLedger().add(1.0, 1.0, 1.0, dissipated_j=math.nan), "dissipated_j"),
        (lambda: ChannelLedger().add(1.0, 1.0, 1.0, 1.0, 0.0), "time_s"),
        (lambda: ChannelLedger().add(1.0, 1.0, 1.0, 1.0, 1.0, stored_j=-1.0), "stored_j"),
        (lambda: ChannelLedger().add([1.0], [1.0], [1.0, 2.0], [1.0], 1.0), "effort_s and flow_s"),
    ],
)
def test_what_cannot_be_worked_with_is_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()


def test_a_refused_interval_leaves_the_ledger_as_it_was():
    ledger = EnergyLedger(1.0)
    for bad in ({"effort": math.nan}, {"stored_j": -1.0}, {"dissipated_j": -1.0}):
        with pytest.raises(ConfigurationError):
            ledger.add(**{"effort": -3.0, "flow": 1.0, "time_s": 1.0, **bad})
    assert (ledger.absorbed_j, ledger.extracted_j, ledger.created_j) == (0.0, 0.0, 0.0)


def oscillator(steps, gain=0.0):
    """A spring of 4 kN/m and a mass of 1.5 kg, by the implicit midpoint rule: it makes no energy but for rounding.

    `gain` is the share by which every step scales the velocity up: a simulation that does make energy.
    """
    mass, k, dt = 1.5, 4e3, 1e-3
    x, v = 0.05, 30.0
    ledger = EnergyLedger(0.5 * mass * v * v + 0.5 * k * x * x)
    for n in range(steps):
        force = 10.0 * math.sin(3.0 * n * dt)
        mean = (v + 0.5 * dt / mass * (force - k * x)) / (1.0 + 0.25 * dt * dt * k / mass)
        x += dt * mean
        v = (2.0 * mean - v) * (1.0 + gain)
        ledger.add(force, mean, dt, stored_j=0.5 * mass * v * v + 0.5 * k * x * x)
    return ledger


@pytest.mark.parametrize("steps", [1, 100, 2000])
def test_storage_that_is_rounded_at_every_step_makes_no_energy(steps):
    ledger = oscillator(steps)
    assert ledger.passive
    # And the bound stays near what rounding does: a share of 1e-15 of the storage per step.
    assert ledger.rounding_j < 2e-15 * (steps + 2) * 1000.0


def test_a_simulation_that_makes_a_hundred_times_the_rounding_is_not_passive():
    honest = oscillator(2000)
    active = oscillator(2000, gain=25.0 * honest.rounding_j / honest.initial_storage_j / 1000)
    assert 20.0 * honest.rounding_j < active.created_j < 200.0 * honest.rounding_j
    assert not active.passive
