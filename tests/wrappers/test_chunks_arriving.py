"""ChunkHandover: which chunks are asked about, by which entry, and what becomes of infos and entries on the way."""

import numpy as np
import pytest
from chunk_worlds import Line

import safe_wrappers as sw

HOLD = 0.1


def at_rest(env):
    return np.zeros(1), np.zeros(1)


def far_away(env):
    return [9.0], [0.0]


def admitting(delay, blend="smoothstep"):
    """Chunks of six entries over a lease that lets through what a machine at 1 m/s can reach from 0."""
    budget = sw.StoppingBudget(far_away, braking=1.0, acceleration=1.0)
    limits = {"max_speed": 1.0, "max_acceleration": 10.0}
    lease = sw.LeaseExpiry(Line(), budget, motion_limits=limits, measured=at_rest, fallback="zero")
    limit = 50.0 if blend == "smoothstep" else None
    return sw.ChunkHandover(lease, 6, 3, delay, blend=blend, rate_limit=limit, fallback="zero")


def chunk(*entries):
    return np.array(entries, np.float32)[:, None]


@pytest.mark.parametrize(
    ("entries", "refused"),
    [((0.1, 0.2, 0.3, 0.5, 0.7, 0.9), True), ((0.9, 0.7, 0.5, 0.3, 0.2, 0.1), False)],
)
def test_a_chunk_is_admitted_by_its_end(entries, refused):
    """In 0.6 s the machine gets less than 0.6 m far."""
    env = admitting(0)
    env.reset(seed=0)
    info = env.step(chunk(*entries))[4]
    assert (info["handover/refused"], info["lease/refused"]) == (refused, refused)


@pytest.mark.parametrize(("blend", "asked"), [("smoothstep", False), ("replace", False), ("ensemble", True)])
def test_a_chunk_that_is_overtaken_as_it_arrives_is_not_asked_about(blend, asked):
    """Only an ensemble has a use for the older of two that come at the same time."""
    env, together = admitting([0, 3], blend), 0
    for seed in range(100):
        env.reset(seed=seed)
        first = env.step(np.full((6, 1), 0.9, np.float32))[4]  # out of reach
        second = env.step(np.full((6, 1), 0.1, np.float32))[4]
        if first["handover/refused"] or second["handover/latency"] != 0:
            continue  # the first came alone
        together += 1
        assert (second["handover/refused"], second["lease/refused"]) == (asked, asked)
        assert env.unwrapped.given[-1][0] == np.float32(0.1)
    assert together > 2


def test_costs_are_summed_up_though_the_env_hands_out_one_info_dict():
    same = {}

    def counting(env):
        same["cost"] = float(env.steps)
        return same

    env = sw.ChunkHandover(Line(infos=counting), 4, 4, rate_limit=50.0, fallback="zero")
    env.reset(seed=0)
    for steps in ((1, 2, 3, 4), (5, 6, 7, 8)):
        assert env.step(np.zeros((4, 1), np.float32))[4]["cost"] == sum(steps)


def test_entries_of_a_slower_policy_are_sent_bit_for_bit_minus_zero_too():
    env = sw.ChunkHandover(Line(), 4, 7, steps_per_entry=2, blend="replace", fallback="zero")
    env.reset(seed=0)
    entries = chunk(-0.0, 0.3, -0.0, -0.7)
    env.step(entries)
    assert np.array(env.unwrapped.given[::2]).tobytes() == entries.tobytes()
