"""Energy through a TeleopChannel, counted from outside: waves create none whatever the network does; plain does."""

from collections import deque

import numpy as np
import pytest
from teleop_worlds import Energies, ceiling, channel, clamp, place

import safe_wrappers as sw
from safe_wrappers.envs.teleop_operator import TeleopOperator
from safe_wrappers.wrappers.teleop_coding import Packet, WaveCoding

B = 40.0
NETWORKS = {
    "ideal": (sw.teleop.Link(), sw.teleop.Link()),
    "300 ms": (sw.teleop.Link(0.15), sw.teleop.Link(0.15)),
    "jitter, loss": (sw.teleop.Link(0.02, 0.03, 0.1), sw.teleop.Link(0.04, 0.05, 0.2)),
}


def hectic(seed, steps):
    """Drivers that put all of the box to use, and dead time."""
    rng = np.random.default_rng(seed)
    action = np.zeros(2)
    for k in range(steps):
        if k % int(rng.integers(20, 80)) == 0:
            action = rng.uniform(-1, 1, 2) * rng.choice([0.0, 0.2, 1.0])
        yield action


@pytest.mark.parametrize("network", NETWORKS)
def test_waves_never_give_out_more_than_went_in_less_what_is_in_flight(network):
    up, down = NETWORKS[network]
    env = channel(up, down, impedance=B)
    energies = Energies(env)
    place(env, (0.1, 0.0))
    for action in hectic(1, 800):
        info = energies.step(action)[4]
    # What is over is what saturation has made of the machine's effort: a share of what went through, and reported.
    assert energies.through > 0.1
    assert energies.worst <= 1e-12 * energies.through + info["teleop/created_j"] + 1e-12
    assert info["teleop/created_j"] < 1e-3 * energies.through
    assert env.ledger.net_j == pytest.approx(energies.into - energies.out, abs=1e-9)


def test_an_operator_in_contact_gets_not_one_picojoule(seed=0):
    up = sw.teleop.Link(0.05, 0.02, 0.05)
    env = channel(up, up, impedance=B)
    energies, operator = Energies(env), TeleopOperator(seed)
    observation, _ = place(env, (0.15, 0.0), seed=seed)
    touched = 0
    for _ in range(2000):
        observation, *_, info = energies.step(operator.act(observation))
        touched += info["contact_force"] > 0.0
    assert touched > 500 and energies.into > 1e-3
    assert energies.worst < 1e-12 and info["teleop/created_j"] < 1e-12


def test_the_same_network_with_plain_coding_creates_energy_and_chatters():
    contacts, created = {}, {}
    for coding in ("plain", "wave"):
        env = channel(0.1, 0.1, impedance=B if coding == "wave" else None)
        energies, operator = Energies(env), TeleopOperator(0)
        observation, _ = place(env, (0.15, 0.0))
        touching, contacts[coding], peak = False, 0, 0.0
        for _ in range(4000):
            observation, *_, info = energies.step(operator.act(observation))
            now = info["contact_force"] > 0.0
            contacts[coding] += now and not touching
            touching, peak = now, max(peak, info["contact_force"])
        created[coding] = info["teleop/created_j"]
        assert created[coding] == pytest.approx(max(energies.worst, 0.0), abs=1e-9)
        if coding == "wave":
            assert peak < 12.0
        else:
            assert peak > 30.0
    assert created["plain"] > 1.0 and created["wave"] < 1e-12
    assert contacts["plain"] >= 4 and contacts["wave"] <= 2


def test_the_operator_feels_a_damper_first_and_the_machine_after_the_round_trip():
    env = channel(0.05, 0.05, impedance=B)
    place(env, (0.0, -0.2))
    flow = np.array([0.1, 0.0])
    felt = np.array([env.step(flow)[0][4] for _ in range(900)])
    np.testing.assert_allclose(felt[:100], B * 0.1, atol=1e-9)
    assert abs(felt[-1]) < 0.2  # it moves freely
    # The flow arrives: the tool moves as the hand does.
    assert env.unwrapped.tool_velocity[0] == pytest.approx(0.1, abs=0.01)


def test_pressing_with_a_still_hand_both_forces_agree():
    env = channel(0.02, 0.02, impedance=B)
    observation, _ = place(env, (0.18, 0.0))
    velocity = 0.0
    for _ in range(4000):  # a mass of 1.5 kg, a damper of 10 N s/m, pushed with 8 N
        velocity += 0.001 / 1.5 * (8.0 - 10.0 * velocity - observation[4])
        observation, *_, info = env.step(np.array([velocity, 0.0]))
    assert abs(velocity) < 1e-3
    assert observation[4] == pytest.approx(8.0, abs=0.05)
    assert info["contact_force"] == pytest.approx(8.0, abs=0.05)


def test_a_wave_that_is_held_by_the_plant_would_create_energy():
    # The test of the test: hold the last wave at the machine instead of paying for it, and count.
    env = channel(0.0, 0.0, impedance=B)
    energies = Energies(env)

    class Held(deque):
        def popleft(self):
            return self[0]

    place(env, (0.1, 0.0))
    env._waves._up = Held()
    for k in range(300):
        energies.step(np.array([0.2, 0.0]) if k < 3 else np.zeros(2))
    assert energies.worst > 0.01


def test_a_filter_inside_pays_for_itself():
    # It brakes hard before the clamp, again and again; none of that is the channel's energy.
    env = channel(0.02, 0.02, impedance=B, inside=lambda env: sw.CBFActionFilter(env, [clamp()]))
    energies, operator = Energies(env), TeleopOperator(0, stops=False, sweep_speed=0.4)
    observation, _ = place(env, (0.184, 0.2))
    changed = 0
    for _ in range(1600):
        observation, *_, info = energies.step(operator.act(observation))
        changed += info["cbf/intervened"]
        assert info["cost"] == 0.0
    assert changed > 20 and info["clearance"] < 0.01
    assert info["teleop/created_j"] < 1e-12


def test_while_authority_is_revoked_the_operator_feels_a_damper_and_nothing_piles_up():
    env = channel(0.002, 0.002, impedance=B, **ceiling())
    place(env, (0.0, 0.1))
    push, seen, flying = np.array([0.0, 0.8]), [], []
    for _ in range(400):
        observation, *_, info = env.step(push)
        seen.append((info["teleop/revoked"], observation[5]))
        flying.append(env.stored_j)
    revoked, forces = (np.array(column) for column in zip(*seen, strict=True))
    # Never more than the impedance's own damping, at the largest while nothing comes back.
    assert revoked.sum() > 100 and forces.max() == pytest.approx(B * 0.8, rel=1e-6)
    # The hand puts b v^2 in per second, and two ticks of it are on their way.
    assert max(flying) == pytest.approx(2 * B * 0.8**2 * 0.001, rel=0.05)
    assert info["teleop/created_j"] < 1e-8  # flows are rounded to the action space's float32


class Machine:
    """A port that says that it resists with nothing."""

    feedthrough, flow, base = 0.0, [0], np.zeros(1)


def test_waves_in_a_queue_are_as_old_as_they_are():
    # A queue puts every wave out in turn, so it is as late as the latest; a single command takes over at once.
    ages = {}
    for coding, impedance in (("wave", B), ("plain", None)):
        env = channel(sw.teleop.Link(0.01, 0.05), 0.0, impedance=impedance)
        place(env)
        ages[coding] = [env.step(np.array([0.1, 0.0]))[4]["teleop/round_trip_s"] for _ in range(400)]
        # What went in and has not come out is in flight or waits; commands are rounded to float32.
        assert coding == "plain" or env.stored_j == pytest.approx(env.ledger.net_j, rel=1e-5)
    np.testing.assert_allclose(ages["wave"][200:], max(ages["plain"]), atol=1e-9)
    assert np.mean(ages["plain"][200:]) < 0.9 * max(ages["plain"])


def test_what_a_machine_took_unpaid_is_paid_by_the_next_waves():
    tick = 0.001
    waves = WaveCoding(Machine(), tick, 2.0)
    waves.reset()
    flows, out = [], 0.0
    for sequence in range(14):
        wave = waves.near(np.array([0.5]))  # sqrt(2 b) v = 1 sqrt(W): half a watt
        flow, _ = waves.far([Packet(None, 0.0, wave)])
        # At first it resists with 5 N although it said 0; then as it says.
        taken = np.array([5.0 if sequence == 0 else 0.0]), flow
        back = waves.settle(*taken, True)
        out += float(taken[0] @ taken[1] + 0.5 * back @ back) * tick
        flows.append(float(flow[0]))
        if sequence == 0:
            assert out == pytest.approx(5.0 * tick)
    # 4.5 mJ too much: the next nine waves of half a millijoule are kept for it.
    np.testing.assert_allclose(flows, [1.0] + 9 * [0.0] + 4 * [1.0], atol=1e-6)
    assert out <= 14 * 0.5 * tick + 1e-12
