import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_wrappers.train.figures.telling import telling_pair

NOISE = np.random.default_rng(1).normal(size=(3000, 6))
PLANTED = {
    "a ring": lambda a, b: np.abs(np.hypot(a, b) - 1.0) < 0.25,
    "two tails": lambda a, b: np.maximum(np.abs(a), np.abs(b)) > 1.8,
    "opposite corners": lambda a, b: a * b > 0.5,
    "a corner": lambda a, b: (a > 1.0) & (b < -0.5),
}


@pytest.mark.parametrize("planted", PLANTED)
@settings(max_examples=15)
@given(columns=st.permutations(range(6)))
def test_the_planted_pair_is_found_wherever_it_is(planted, columns):
    a, b = columns[:2]
    flags = PLANTED[planted](NOISE[:, a], NOISE[:, b])
    assert telling_pair(NOISE, flags) == (min(a, b), max(a, b))


def test_units_do_not_matter_and_nothing_to_see_does_no_harm():
    flags = PLANTED["a ring"](NOISE[:, 2], NOISE[:, 4])
    stretched = np.exp(NOISE) * 1e4  # any increasing change of scale
    assert telling_pair(stretched, flags) == (2, 4)
    blind = np.column_stack([np.full(3000, np.nan), np.zeros(3000), NOISE])
    assert telling_pair(blind, flags) == (4, 6)


def test_absence_tells_too():
    seen = NOISE[:, 3].copy()
    flags = NOISE[:, 0] > 0
    seen[flags] = np.nan  # a vase that is not there whenever the filter acts
    coordinates = np.column_stack([NOISE[:, 1], seen, NOISE[:, 2]])
    assert 1 in telling_pair(coordinates, flags)


def test_many_steps_are_thinned_but_rare_flags_are_kept():
    flags = np.zeros(60_000, dtype=bool)
    flags[1] = True  # thinning by three would leave none
    coordinates = np.random.default_rng(0).normal(size=(60_000, 2))
    assert telling_pair(coordinates, flags) == (0, 1)
