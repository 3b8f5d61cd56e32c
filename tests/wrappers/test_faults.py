"""The faults: what arrives, when, with which stamp; that they are seeded and touch nothing else; that leases hold."""

import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant, lease, read_cart, stop
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.faults import FAULTS, Outages, RepeatedCommands
from safe_wrappers.wrappers.layer import CommandReceiver

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
FULL = np.array([1.0, 0.0], np.float32)
EXAMPLES = {
    "Outages": {"mean_between_s": 1.0, "mean_length_s": 0.8},
    "RepeatedCommands": {"share": 0.4},
}
every_fault = pytest.mark.parametrize("kind", EXAMPLES)


def faulty(kind, env, **more):
    return FAULTS[kind](env, **{**EXAMPLES[kind], **more})


class Ear(gym.Wrapper, CommandReceiver):
    """Writes down what arrives: the stamp (None: nothing) and the action, of a step of `control_dt`."""

    def __init__(self, env, control_dt=0.1):
        super().__init__(env)
        self.control_dt = control_dt

    def reset(self, **kwargs):
        self.heard, self.stamp = [], "none given"
        return self.env.reset(**kwargs)

    def step(self, action):
        self.heard.append((self.stamp, None if self.stamp is None else np.array(action).ravel()[0]))
        return self.env.step(action)

    @property
    def now_s(self):
        return len(self.heard) * self.control_dt

    def set_observation_time(self, observed_s):
        self.stamp = observed_s


def numbered(t):
    """An action that says at which step it was made."""
    return np.array([t / 1000.0, 0.0])


def hear(env, ear, steps, seed=0):
    """What arrives of the actions 0, 1, 2, ...: (stamp, number) or (None, None), and whether the fault was active."""
    env.reset(seed=seed)
    active = [env.step(numbered(t))[4]["fault/active"] for t in range(steps)]
    return [(s, None if a is None else round(1000.0 * a)) for s, a in ear.heard], active


def listened(kind, *, steps=200, seed=0, **more):
    ear = Ear(BrakedCart())
    return hear(faulty(kind, ear, **more), ear, steps, seed)


# What arrives -------------------------------------------------------------------------------------------------


def scripted(env, numbers):
    """The fault draws these instead of random numbers."""
    left = list(numbers)

    def pop(*_):
        return left.pop(0)

    env.random = SimpleNamespace(reset=lambda *_: None, draw=SimpleNamespace(random=pop, exponential=pop))
    return env


@given(
    numbers=st.lists(st.floats(0.0, 1.0, exclude_max=True), min_size=1, max_size=30),
    share=st.floats(0.0, 1.0),
)
def test_repeated_commands_keep_their_stamp(numbers, share):
    ear = Ear(BrakedCart())
    heard, active = hear(scripted(RepeatedCommands(ear, share), numbers), ear, len(numbers))
    before = (None, None)
    for t, number in enumerate(numbers):
        if number >= share:
            before = (t * 0.1, t)
        assert heard[t] == before
        assert active[t] == (number < share)


SPELLS = [0.25, 0.3, 0.1, 0.0, 0.4, 9.0]
"""Well until 0.25, ill until 0.55, well until 0.65, ill for no time, well until 1.05, ill for the rest."""
ILL = [3, 4, 5, 11, 12, 13, 14]


def test_outages_lose_everything():
    ear = Ear(BrakedCart())
    heard, active = hear(scripted(Outages(ear, 1.0, 1.0), SPELLS), ear, 15)
    assert [t for t, h in enumerate(heard) if h == (None, None)] == ILL == [t for t in range(15) if active[t]]
    assert all(heard[t] == (t * 0.1, t) for t in range(15) if t not in ILL)


# Random -------------------------------------------------------------------------------------------------------


@every_fault
def test_the_same_seed_gives_the_same_faults_and_the_next_episode_goes_on(kind):
    def episodes(seed):
        ear = Ear(BrakedCart())
        env = faulty(kind, ear)
        first = hear(env, ear, 150, seed)[0]
        return first, hear(env, ear, 150, None)[0], hear(env, ear, 150, None)[0]

    a, b = episodes(7), episodes(7)
    assert a == b
    assert a[0] != a[1] and a[1] != a[2]
    assert episodes(8)[0] != a[0]
    ear = Ear(BrakedCart())
    env = faulty(kind, ear)
    hear(env, ear, 40, 3)
    assert hear(env, ear, 150, 7)[0] == a[0]


@pytest.mark.parametrize("share", [0.0, 0.2, 0.7, 1.0])
def test_the_share(share):
    heard, active = listened("RepeatedCommands", steps=4000, share=share)
    lost = sum(h[1] != t for t, h in enumerate(heard)) / 4000
    assert lost == pytest.approx(share, abs=5.0 * math.sqrt(share * (1.0 - share) / 4000) + 1e-12)
    assert sum(active) == round(4000 * lost)


def test_spells_are_as_long_and_as_far_apart_as_declared():
    heard, _ = listened("Outages", steps=40_000, mean_between_s=3.0, mean_length_s=1.5)
    ill = np.array([h[1] != t for t, h in enumerate(heard)])
    assert ill.mean() == pytest.approx(1.5 / 4.5, abs=0.03)
    starts = np.flatnonzero(~ill[:-1] & ill[1:])
    assert len(starts) == pytest.approx(4000.0 / 4.5, rel=0.15)
    lengths = np.diff(np.flatnonzero(np.diff(ill.astype(int)) != 0))
    assert lengths.max() > 40  # exponential: some last three times the mean


# Nobody inside to tell ----------------------------------------------------------------------------------------


@every_fault
def test_without_a_receiver_the_robot_goes_on_with_the_last_command(kind):
    cart = BrakedCart()
    env = faulty(kind, cart)
    expected, active = listened(kind, steps=80, seed=3)
    env.reset(seed=3)
    last = 0
    for t in range(80):
        info = env.step(numbered(t))[4]
        last = last if expected[t][1] is None else expected[t][1]
        assert cart.given[t][0] == pytest.approx(last / 1000.0)
        assert info["fault/active"] == active[t]


# Nested -------------------------------------------------------------------------------------------------------


def test_the_outer_one_comes_first():
    # The outer loses 1 and 2; the inner repeats at 2 and 3: the last that arrived at it was 0.
    ear = Ear(BrakedCart())
    inner = scripted(RepeatedCommands(ear, 0.5), [0.9, 0.9, 0.1, 0.1, 0.9])
    outer = scripted(Outages(inner, 1.0, 1.0), [0.05, 0.2, 9.0])
    heard, active = hear(outer, ear, 5)
    assert heard == [(0.0, 0), (None, None), (0.0, 0), (0.0, 0), (0.4, 4)]
    assert active == [False, True, True, True, False]
    # The other way round: what the outer repeats may get lost.
    ear = Ear(BrakedCart())
    inner = scripted(Outages(ear, 1.0, 1.0), [0.05, 0.1, 9.0])
    outer = scripted(RepeatedCommands(inner, 0.5), [0.9, 0.9, 0.1, 0.9, 0.1])
    assert [h[1] for h in hear(outer, ear, 5)[0]] == [0, None, 1, 3, 3]


# With a lease -------------------------------------------------------------------------------------------------


def leased(cart, **more):
    given_ = {"braking": cart.braking, "acceleration": cart.drive, "fallback": stop}
    return lease(cart, read_cart, plant=cart_plant(cart.dt), **{**given_, **more})


NESTED = [
    *([kind] for kind in EXAMPLES),
    ["RepeatedCommands", "Outages"],
    ["Outages", "RepeatedCommands"],
]


def drive(rng, cart, t):
    """Fast and careful: full throttle until it would have to brake, then brakes. What kills is a stale throttle."""
    room = cart.wall - cart.x - cart.v * 0.3 - 0.05
    if cart.v**2 / (2.0 * cart.braking) > room:
        return np.array([0.0, 1.0])
    return np.array([1.0, 0.0]) if rng.random() < 0.8 else np.array([rng.uniform(-1.0, 1.0), 0.0])


@pytest.mark.parametrize("kinds", NESTED, ids="+".join)
def test_nothing_is_hit_whatever_goes_wrong(kinds):
    hits, braked, moved = {True: 0, False: 0}, 0, 0
    for seed in range(25):
        for guarded in hits:
            rng = np.random.default_rng(seed)
            dt = float(rng.choice([0.02, 0.1]))
            delay, age = rng.uniform(0.0, 2.0 * dt, 2)
            cart = BrakedCart(
                dt,
                rng.uniform(2.0, 8.0),
                rng.uniform(0.5, 3.0),
                rng.uniform(1.0, 5.0),
                delay_s=delay,
                age_s=age,
            )
            env = cart
            if guarded:
                env = leased(cart, delays_s=delay + age, blend_time=float(rng.choice([0.0, 0.2])))
            for kind in reversed(kinds):
                env = faulty(kind, env)
            env.reset(seed=seed)
            for t in range(round(6.0 / dt)):
                info = env.step(drive(rng, cart, t))[4]
                braked += info.get("lease/braking", False)
            hits[guarded] += cart.farthest >= cart.wall
            moved += guarded and cart.x > 0.3
    assert hits[True] == 0
    assert moved > 0 and braked > 0
    if "Outages" in kinds:
        assert hits[False] > 3, hits


def test_repeats_are_caught_though_commands_keep_coming():
    env = RepeatedCommands(leased(BrakedCart(wall=1e6), max_lease_s=0.3), 0.97)
    env.reset(seed=1)
    braking = [env.step(FULL)[4]["lease/braking"] for _ in range(100)]
    assert sum(braking) > 40 and not all(braking)


@every_fault
def test_chunks_are_carried_lost_and_repeated_as_a_whole(kind):
    cart = BrakedCart()
    chunks = sw.ChunkHandover(cart, 6, 2, rate_limit=1e9, fallback="zero")
    heard, stamps = [], []
    step, stamp = chunks.step, chunks.set_observation_time
    chunks.set_observation_time = lambda observed_s: (stamps.append(observed_s), stamp(observed_s))[1]
    chunks.step = lambda action: (heard.append((stamps[-1], np.array(action))), step(action))[1]
    env = faulty(kind, chunks)
    env.reset(seed=2)
    sent = [np.full((6, 2), 0.01 * t) + np.arange(6)[:, None] * 0.001 for t in range(40)]
    infos = [env.step(chunk)[4] for chunk in sent]
    refused = 0
    for t, (stamp, chunk) in enumerate(heard):
        if stamp is None:
            assert infos[t]["fault/active"]
            continue
        made = round(stamp / 0.2)
        assert chunk.tobytes() == sent[made].tobytes() and infos[t]["fault/active"] == (made != t)
        refused += infos[t]["handover/refused"]
    lost = sum(info["fault/active"] for info in infos)
    assert 5 < lost <= 40
    starved = sum(info["handover/starved"] for info in infos)
    assert starved > 0 or kind == "RepeatedCommands"
    if kind == "RepeatedCommands":
        assert refused > 0  # a repeated chunk is not newer than the one in force


# Contract and bad input ---------------------------------------------------------------------------------------


BAD = {
    "RepeatedCommands": [{"share": -0.1}, {"share": 1.1}, {"share": math.nan}, {"share": None}],
    "Outages": [
        {"mean_between_s": 0.0, "mean_length_s": 1.0},
        {"mean_between_s": 1.0, "mean_length_s": -1.0},
        {"mean_between_s": math.nan, "mean_length_s": 1.0},
        {"mean_between_s": 1.0, "mean_length_s": math.inf},
        {"mean_between_s": "never", "mean_length_s": 1.0},
    ],
}


@pytest.mark.parametrize(("kind", "bad"), [(kind, bad) for kind, all_ in BAD.items() for bad in all_])
def test_numbers_that_make_no_sense(kind, bad):
    name = next((k for k, v in bad.items() if v not in (1.0,)), "")
    with pytest.raises(ConfigurationError, match=name):
        FAULTS[kind](BrakedCart(), **bad)
