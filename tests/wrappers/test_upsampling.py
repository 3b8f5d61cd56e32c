"""Chunks at the policy's rate on a faster loop, against scipy's splines."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.chunk_queue import Upsampling


@pytest.mark.parametrize(("entries", "steps"), [(2, 3), (5, 4), (9, 33)])
def test_commands_between_entries_are_the_spline_through_them(entries, steps):
    chunk = np.random.default_rng(0).normal(size=(entries, 3))
    commands = Upsampling(entries, steps).commands(chunk)
    times = np.arange(entries) * steps
    spline = CubicHermiteSpline(times, chunk, np.gradient(chunk, steps, axis=0))
    assert commands == pytest.approx(spline(np.arange(times[-1] + 1)), abs=1e-12)
    assert np.array_equal(commands[::steps], chunk)


class Sent(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.sent = []

    def step(self, action):
        self.sent.append(np.array(action))
        return self.env.step(action)


def test_a_slow_chunk_drives_a_fast_loop_late_and_within_the_limit():
    inner = Sent(gym.make("FlexJointReach-v0"))
    env = sw.ChunkHandover(inner, 5, 10, inference_delay=3, steps_per_entry=5, rate_limit=[30.0, 10.0])
    assert env.action_space.shape == (5, 2)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    chunks = [
        0.4 * rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32) for _ in range(3)
    ]
    for chunk in chunks:
        info = env.step(chunk)[4]
    assert info["handover/latency"] == 3
    sent = np.array(inner.sent, dtype=np.float64)
    assert (np.abs(np.diff(sent, axis=0)) <= np.array([30.0, 10.0]) * 0.01 + 1e-12).all()


def test_a_late_slow_chunk_is_consumed_from_where_its_delay_ended():
    inner = Sent(gym.make("FlexJointReach-v0"))
    env = sw.ChunkHandover(inner, 5, 10, inference_delay=3, steps_per_entry=5, blend="replace")
    env.reset(seed=0)
    env.action_space.seed(0)
    first, second = (env.action_space.sample() for _ in range(2))
    env.step(first)
    env.step(second)
    spline = [
        np.clip(Upsampling(5, 5).commands(c.astype(np.float64)), [-3.0, -1.0], [3.0, 1.0])
        for c in (first, second)
    ]
    sent = np.array(inner.sent, dtype=np.float64)
    # 21 commands of a chunk: the first's from its fourth on, its left-over for three steps, then the second's.
    assert sent[3:13] == pytest.approx(spline[0][3:13], abs=1e-6)
    assert sent[13:20] == pytest.approx(spline[1][3:10], abs=1e-6)


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"steps_per_entry": 0}, "steps_per_entry"),
        ({"steps_per_entry": 1.5}, "steps_per_entry"),
        ({"chunk_size": 1, "execution_horizon": 1, "steps_per_entry": 2}, "one entry leads"),
        ({"execution_horizon": 20, "steps_per_entry": 4}, "H = 17 control steps"),
    ],
)
def test_bad_sizes(sizes, words):
    with pytest.raises(ConfigurationError, match=words):
        sw.ChunkHandover(
            gym.make("Reacher-v5"), **{"chunk_size": 5, "execution_horizon": 3, "rate_limit": 5.0, **sizes}
        )
