"""ChunkHandover(flexible=): what it chooses, smoothsteps that are not cut short, what a seam leaves."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from chunk_worlds import Line
from hypothesis import given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.control.handover.vibration import smoothstep_share
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants import RigidModelCheck

HOLD = 0.1
RINGS = RigidModelCheck(("spring",), (12.0,), (0.01,), 0.1, 8.3, HOLD)
SHARE = 0.05
pytestmark = pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")


def smooth(s):
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def sent(chunks, horizon, **more):
    line = Line(chunks[0].shape[1], dtype=np.float64)
    env = sw.ChunkHandover(line, len(chunks[0]), horizon, fallback="hold", **more)
    env.reset(seed=0)
    infos = [env.step(chunk)[4] for chunk in chunks]
    return np.array(line.given), infos


def shortest(share, resonance):
    """By trying: the first of fine durations from which on the share is kept."""
    spans = np.linspace(0.01, 5.0, 500_000)
    return spans[np.argmax(smoothstep_share(resonance * spans) <= share)]


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5))
def test_held_chunks_are_a_sum_of_whole_smoothsteps_however_often_a_seam_comes(seed, horizon):
    rng = np.random.default_rng(seed)
    levels = np.concatenate([[0.0], rng.uniform(-0.08, 0.08, 6)])
    chunks = [np.full((16, 1), level) for level in levels]
    found, infos = sent(chunks, horizon, flexible=RINGS, vibration_share=SHARE)
    steps = round(infos[1]["handover/blend_time"] / HOLD)
    assert steps > horizon and steps == np.ceil(shortest(SHARE, 12.0) / HOLD)
    t = np.arange(len(found))
    closed = sum(
        (after - before) * smooth((t - horizon * (k + 1) + 1) / steps)
        for k, (before, after) in enumerate(itertools.pairwise(levels))
    )
    np.testing.assert_allclose(found[:, 0], closed, atol=1e-9)
    cut, _ = sent(chunks, horizon, blend_time=steps * HOLD)
    if horizon < 4:
        assert np.abs(cut[:, 0] - closed).max() > 1e-4  # without it each starts again from the middle


def test_it_is_the_stricter_of_what_springs_ask_and_what_the_user_gave():
    chunks = [np.full((20, 1), level) for level in (0.0, 0.9)]
    found, infos = sent(chunks, 8, flexible=RINGS, vibration_share=SHARE)
    rate = 1.875 * 2.0 / shortest(SHARE, 12.0)  # of a blend over the box from -1 to 1
    assert np.abs(np.diff(found[:, 0])).max() <= rate * HOLD + 1e-12
    assert infos[1]["handover/blend_time"] == pytest.approx(HOLD * np.ceil(shortest(SHARE, 12.0) / HOLD))
    slower, infos = sent(chunks, 8, flexible=RINGS, vibration_share=SHARE, rate_limit=1.0, blend_time=1.5)
    assert np.abs(np.diff(slower[:, 0])).max() <= 1.0 * HOLD + 1e-12
    assert infos[1]["handover/blend_time"] >= 1.7 - 1e-9  # 1.875 * 0.9 / 1.0, rounded up
    _, infos = sent([0.1 * chunk for chunk in chunks], 8, flexible=RINGS, blend_time=1.5)
    assert infos[1]["handover/blend_time"] == pytest.approx(1.5)


def test_a_seam_on_the_flexible_arm_leaves_no_more_than_its_share():
    """One change of torque at the elbow from rest: what rings on after it, against what rings on after a step."""

    def left(**how):
        env = sw.ChunkHandover(gym.make("FlexJointReach-v0"), 40, 20, fallback="zero", **how)
        env.reset(seed=0)
        # The arm hardly turns, so that its resonances stay.
        for level in (0.0, 0.05):
            env.step(np.full((40, 2), [0.0, level], np.float32))
        return env.step(np.full((40, 2), [0.0, 0.05], np.float32))[4]["vibration_energy"]

    step = left(blend="replace")
    for share in (0.1, 0.01):
        for blend in ("smoothstep", "quintic"):
            assert left(blend=blend, flexible="auto", vibration_share=share) <= share * step
    assert left(blend_time=0.03) > 0.1 * step


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"flexible": RINGS, "vibration_share": 1.0}, "share of a step's energy is above 0 and below 1"),
        ({"flexible": RINGS, "blend": "replace"}, "limits and flexible are for smoothstep"),
        ({"flexible": RINGS, "vibration_share": 1e-6}, "longer than a chunk's rest"),
        ({"flexible": 3.0}, 'flexible is a RigidModelCheck, the dict of one, or "auto"'),
    ],
)
def test_bad_input_is_refused(arguments, says):
    with pytest.raises(ConfigurationError, match=says):
        sw.ChunkHandover(Line(1), 16, 8, fallback="hold", **arguments)
