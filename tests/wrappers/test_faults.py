"""The faults: what arrives, when, with which stamp; that they are seeded; that chunks hold with them."""

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, lease, read_cart
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.errors import ActionError
from safe_wrappers.wrappers.faults import FAULTS, Outages, RepeatedCommands
from safe_wrappers.wrappers.layer import CommandReceiver

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
EXAMPLES = {
    "Outages": {"mean_between_s": 1.0, "mean_length_s": 0.8},
    "RepeatedCommands": {"share": 0.4},
}
every_fault = pytest.mark.parametrize("kind", EXAMPLES)
DT = 0.1


def faulty(kind, env):
    return FAULTS[kind](env, **EXAMPLES[kind])


class Ear(gym.Wrapper, CommandReceiver):
    """Writes down what arrives: the stamp (None: nothing) and at which step the action was made."""

    control_dt = DT

    def reset(self, **kwargs):
        self.heard, self.stamp = [], "none given"
        return self.env.reset(**kwargs)

    def step(self, action):
        made = None if self.stamp is None else round(1000.0 * float(action[0]))
        self.heard.append((self.stamp, made))
        return self.env.step(action)

    @property
    def now_s(self):
        return len(self.heard) * DT

    def set_observation_time(self, observed_s):
        self.stamp = observed_s


def send(env, steps, seed=0):
    """Actions that say at which step they were made; whether the fault was active."""
    env.reset(seed=seed)
    return [env.step(np.array([t / 1000.0, 0.0]))[4]["fault/active"] for t in range(steps)]


def listened(make, steps, seed=0, ear=None):
    """What arrives of the actions 0, 1, 2, ...: (stamp, number) or (None, None), and whether the fault was active."""
    ear = ear or Ear(BrakedCart())
    active = send(make(ear), steps, seed)
    return ear.heard, active


# What arrives -----------------------------------------------------------------------------------------------------


class Script:
    """In place of random numbers."""

    def __init__(self, numbers):
        self.left = list(numbers)
        self.draw = self

    def reset(self, env, seed):
        pass

    def random(self):
        return self.left.pop(0)

    def exponential(self, scale):
        return scale * self.left.pop(0)


def scripted(fault, numbers):
    fault.random = Script(numbers)
    return fault


@given(
    numbers=st.lists(st.floats(0.0, 1.0, exclude_max=True), min_size=1, max_size=30),
    share=st.floats(0.0, 1.0),
)
def test_repeated_commands_keep_their_stamp(numbers, share):
    heard, active = listened(lambda ear: scripted(RepeatedCommands(ear, share), numbers), len(numbers))
    arrived = (None, None)
    for t, number in enumerate(numbers):
        if number >= share:
            arrived = (t * DT, t)
        assert heard[t] == arrived and active[t] == (number < share)


@given(st.lists(st.floats(0.0, 1.0), max_size=12))
def test_outages_lose_everything(spells):
    # Well, ill, well, ... for so many times the means; then as it is.
    heard, active = listened(lambda ear: scripted(Outages(ear, 0.8, 0.5), [*spells, 99.0]), 20)
    ends = np.cumsum([(0.5 if i % 2 else 0.8) * spell for i, spell in enumerate(spells)])
    for t in range(20):
        ill = (ends <= t * DT).sum() % 2 == 1
        assert heard[t] == ((None, None) if ill else (t * DT, t)) and active[t] == ill


def test_the_outer_one_comes_first():
    # The outer loses 1 and 2; the inner repeats at 2 and 3: the last that arrived at it was 0.
    def outages_outside(ear):
        inner = scripted(RepeatedCommands(ear, 0.5), [0.9, 0.9, 0.1, 0.1, 0.9])
        return scripted(Outages(inner, 1.0, 1.0), [0.05, 0.2, 9.0])

    heard, active = listened(outages_outside, 5)
    assert heard == [(0.0, 0), (None, None), (0.0, 0), (0.0, 0), (0.4, 4)]
    assert active == [False, True, True, True, False]

    # The other way round: what the outer repeats may get lost.
    def outages_inside(ear):
        inner = scripted(Outages(ear, 1.0, 1.0), [0.05, 0.1, 9.0])
        return scripted(RepeatedCommands(inner, 0.5), [0.9, 0.9, 0.1, 0.9, 0.1])

    assert [made for _, made in listened(outages_inside, 5)[0]] == [0, None, 1, 3, 3]


@every_fault
def test_without_a_receiver_the_robot_goes_on_with_the_last_command(kind):
    cart, last = BrakedCart(), 0
    heard, active = listened(lambda ear: faulty(kind, ear), 80, seed=3)
    assert send(faulty(kind, cart), 80, seed=3) == active
    for (_, made), executed in zip(heard, cart.given, strict=True):
        last = last if made is None else made
        assert executed[0] == pytest.approx(last / 1000.0)


@pytest.mark.parametrize("bad", [[np.nan, 0.0], [0.0], ["fast", 0.0], 1.0])
def test_what_is_no_action_is_refused_at_once_though_it_would_never_arrive(bad):
    cart = BrakedCart()
    env = RepeatedCommands(sw.RecordInterventions(cart), 1.0)
    env.reset(seed=0)
    with pytest.raises(ActionError):
        env.step(bad)
    assert not cart.given


def test_a_layer_inside_that_decides_gets_what_is_not_finite():
    env = RepeatedCommands(
        lease(BrakedCart(), read_cart, braking=4.0, acceleration=2.0, fallback="zero"), 0.0
    )
    env.reset(seed=0)
    assert env.step(np.array([np.nan, 0.0]))[4]["lease/refused"]


# Random -----------------------------------------------------------------------------------------------------------


@every_fault
def test_the_same_seed_gives_the_same_faults_and_the_next_episode_goes_on(kind):
    def episodes(*seeds):
        ear = Ear(BrakedCart())
        env = faulty(kind, ear)
        return [listened(lambda _: env, 150, seed, ear)[0] for seed in seeds]

    one = episodes(7, None, None)
    assert one == episodes(7, None, None)
    assert one[0] != one[1] and one[1] != one[2]
    assert episodes(8)[0] != one[0] == episodes(3, 7)[1]


def test_two_of_one_kind_do_not_strike_together():
    _, both = listened(lambda ear: RepeatedCommands(RepeatedCommands(ear, 0.5), 0.5), 4000)
    assert np.mean(both) == pytest.approx(0.75, abs=0.04)


# With chunks (with leases: test_stack.py) -------------------------------------------------------------------------


@every_fault
def test_chunks_are_carried_lost_and_repeated_as_a_whole(kind):
    env = faulty(kind, sw.ChunkHandover(BrakedCart(), 6, 2, rate_limit=1e9, fallback="zero"))
    cart = env.unwrapped
    env.reset(seed=2)
    chunks = [np.full((6, 2), 0.01 * t) + np.arange(6)[:, None] * 0.001 for t in range(40)]
    infos = [env.step(chunk)[4] for chunk in chunks]
    first = np.array(cart.given)[::2, 0]  # of the two executed entries of each step
    for t, info in enumerate(infos):
        if not info["fault/active"]:
            assert first[t] == pytest.approx(chunks[t][0, 0]) and not info["handover/refused"]
    lost = sum(info["fault/active"] for info in infos)
    assert 5 < lost < 40
    # A repeated chunk is not newer than the one in force; after a lost one entries run out.
    told = "handover/refused" if kind == "RepeatedCommands" else "handover/starved"
    assert sum(info[told] for info in infos) > 0
