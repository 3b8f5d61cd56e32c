"""Link and Line: every packet arrives once within its time or is lost, in order where it should be, seeded."""

import dataclasses
import json

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.serialize import plain_data
from safe_wrappers.wrappers.teleop import LONGEST_DELAY_S, Line, link_from

TICK = 0.001


def line(link, seed=0, stream="a line"):
    made = Line(link, stream, 1e-6 * TICK)
    made.reset(gym.make("Pendulum-v1"), seed)
    return made


def traffic(made, ticks=400):
    """(sent tick, arrived tick or None) by sequence, and the order of arrival."""
    sent, came, order = {}, {}, []
    for k in range(ticks):
        sequence, lost = made.send(k, k * TICK)
        sent[sequence] = k
        if lost:
            came[sequence] = None
        for packet in made.receive(k * TICK):
            assert packet.load == sent[packet.sequence] and packet.sequence not in came
            came[packet.sequence] = k
            order.append(packet.sequence)
    return sent, came, order


@settings(max_examples=40)
@given(
    delay=st.integers(0, 30),
    jitter=st.integers(0, 30),
    loss=st.sampled_from([0.0, 0.2, 1.0]),
    in_order=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_every_packet_arrives_once_in_its_time_or_is_lost(delay, jitter, loss, in_order, seed):
    link = sw.teleop.Link(delay * TICK, jitter * TICK, loss, in_order)
    sent, came, order = traffic(line(link, seed), 150)
    for sequence, k in sent.items():
        if sequence not in came:
            assert k + delay + jitter >= 149  # still on its way
        elif came[sequence] is not None:
            assert delay <= came[sequence] - k <= delay + jitter + 1
    if in_order:
        assert order == sorted(order)
    if loss == 1.0:
        assert not order


def test_datagrams_overtake_each_other_and_a_stream_does_not():
    loose = traffic(line(sw.teleop.Link(0.01, 0.03, in_order=False)))[2]
    assert loose != sorted(loose)
    stream = traffic(line(sw.teleop.Link(0.01, 0.03)))[2]
    assert stream == sorted(stream) and len(stream) > 350


def test_loss_and_outages_take_their_share():
    for link, expected in (
        (sw.teleop.Link(loss=0.3), 0.3),
        (sw.teleop.Link(outage_between_s=0.2, outage_length_s=0.1), 1.0 / 3.0),
    ):
        shares = []
        for seed in range(4):
            came = traffic(line(link, seed), 20_000)[1].values()
            shares.append(sum(c is None for c in came) / 20_000)
        assert np.mean(shares) == pytest.approx(expected, abs=0.06)
    lost = [
        c is None
        for c in traffic(line(sw.teleop.Link(outage_between_s=0.2, outage_length_s=0.1)), 3000)[1].values()
    ]
    changes = np.count_nonzero(np.diff(np.array(lost, int)))
    assert changes < 60  # in spells, not one by one


def test_random_numbers_are_seeded_and_kept_apart():
    link = sw.teleop.Link(0.01, 0.05, 0.1, False)
    first = traffic(line(link))
    assert traffic(line(link)) == first
    assert traffic(line(link, seed=1)) != first and traffic(line(link, stream="another")) != first


def test_links_are_plain_data():
    link = sw.teleop.Link(0.1, 0.02, 0.1, False, 2.0, 0.3)
    data = json.loads(json.dumps(plain_data(link)))
    assert link_from("uplink", data) == link == link_from("uplink", link)
    assert link_from("uplink", 0.2) == sw.teleop.Link(0.2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        link.delay_s = 0.0


@pytest.mark.parametrize(
    "arguments",
    [
        {"delay_s": -0.1},
        {"delay_s": np.nan},
        {"delay_s": "soon"},
        {"jitter_s": -1.0},
        {"loss": 1.1},
        {"loss": -0.1},
        {"in_order": 1},
        {"delay_s": LONGEST_DELAY_S, "jitter_s": 0.1},
        {"outage_between_s": 1.0},
        {"outage_length_s": 1.0},
        {"outage_between_s": 0.0, "outage_length_s": 1.0},
    ],
)
def test_links_that_cannot_be_are_refused(arguments):
    with pytest.raises(ConfigurationError):
        sw.teleop.Link(**arguments)
