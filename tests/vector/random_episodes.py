"""Hypothesis strategies: episodes that end at any time, driven by any numbers."""

import numpy as np
from hypothesis import strategies as st

STEPS = 12

lengths = st.lists(st.integers(1, 4) | st.integers(-4, -1), min_size=1, max_size=5)
"""How many steps each episode of one sub-env lasts; negative ones are truncated, after the last four each."""

proposals = st.lists(
    st.sampled_from([0.0, 1.0, -1.0, 0.3, -0.7, 1.5, -np.inf, np.nan]), min_size=1, max_size=STEPS
)
"""What one sub-env's policy says, over and over."""

plays = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**20),
        "ends": st.lists(lengths, min_size=3, max_size=3),
        "said": st.lists(proposals, min_size=3, max_size=3),
    }
)
"""One play of three carts: a seed, when each one's episodes end, and what their policies say."""


def spoken(said):
    """The actions of a play by sub-env, episode and step."""

    def action(i, k, t):
        return np.array([said[i][(3 * k + t) % len(said[i])]], np.float32)

    return action
