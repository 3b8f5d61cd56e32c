"""Whatever is done and whenever it ends: vector envs are single loops. Each env is used for every example, so what an
example leaves behind (an episode half-way, commands in flight) must be gone at the next one's reset."""

import contextlib

import pytest
from hypothesis import given, settings
from random_episodes import STEPS, plays, spoken
from single_loops import assert_same_episodes, by_hand, unroll
from vector_worlds import KINDS, WAYS, cart, sub_envs

EXAMPLES = {"sync": 16, "async": 8}


@pytest.mark.parametrize(("kind", "mode"), WAYS)
def test_any_actions_and_any_ends(kind, mode):
    envs = KINDS[kind](sub_envs(cart), autoreset_mode=mode)

    @settings(max_examples=EXAMPLES[kind])
    @given(play=plays)
    def check(play):
        actions, options = spoken(play["said"]), {"ends": play["ends"]}
        episodes = unroll(envs, actions, seed=play["seed"], steps=STEPS, options=options)
        for i, got in enumerate(episodes):
            wanted = by_hand(cart, actions, i, seed=play["seed"] + i, steps=STEPS, options=options)
            assert_same_episodes(got, wanted, f"sub-env {i}, ")

    with contextlib.closing(envs):
        check()
