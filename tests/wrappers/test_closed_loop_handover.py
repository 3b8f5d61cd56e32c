"""ChunkHandover in closed loops on real envs: hundreds of seams, the limit kept, and what a seam leaves ringing."""

import gymnasium as gym
import numpy as np
import pytest
from chunk_worlds import ChunkHandover

import safe_wrappers as sw

pytestmark = pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")
ENVS = {"FlexJointReach-v0": 30.0, "Reacher-v5": 8.0}
"""Env -> limit, action units per second."""


class Recorder(gym.Wrapper):
    """Commands and infos of every control step, episodes apart."""

    def reset(self, **how):
        self.commands, self.infos = [], []
        return self.env.reset(**how)

    def step(self, action):
        assert self.action_space.contains(action) and np.isfinite(action).all()
        found = self.env.step(action)
        self.commands.append(np.array(action, np.float64))
        self.infos.append(dict(found[4]))
        return found


def smooth_chunks(env, rng, step_of=0.05):
    """Chunks that move slowly in themselves, and have nothing to do with each other."""
    space = env.action_space
    size, controls = space.shape
    while True:
        start, swing = rng.uniform(-0.8, 0.8, controls), rng.uniform(-step_of, step_of, controls)
        j = np.arange(size)[:, None]
        wave = np.sin(0.2 * j + rng.uniform(0, 6))
        yield (space.high * np.clip(start + swing * wave, -1, 1)).astype(np.float32)


def episodes(env, chunks, steps, seed=0, late=None):
    """Steps over as many episodes as it takes; the infos, and the recorder's commands and infos per episode."""
    recorder, seams, infos, done = env, 0, [], True
    while not isinstance(recorder, Recorder):
        recorder = recorder.env
    found = []
    for k in range(steps):
        if done:
            if k:
                found.append((np.array(recorder.commands), recorder.infos))
            env.reset(seed=seed if not k else None)
        if late is not None and late.random() < 0.2:
            env.set_observation_time(None)
        _, _, terminated, truncated, info = env.step(next(chunks))
        infos.append(info)
        seams += info["handover/latency"] >= 0
        done = terminated or truncated
    found.append((np.array(recorder.commands), recorder.infos))
    return infos, found, seams


@pytest.mark.parametrize("env_id", ENVS)
def test_hundreds_of_seams_and_not_one_beyond_the_limit(env_id):
    """Late by chance, lost by chance, with the brake as the fallback."""
    limit = ENVS[env_id]
    recorder = Recorder(gym.make(env_id))
    env = ChunkHandover(recorder, 24, 8, [0, 5], rate_limit=limit)
    rng = np.random.default_rng(0)
    infos, found, seams = episodes(env, smooth_chunks(env, rng), 120, late=rng)
    assert seams > 80 and len(found) >= 4
    assert sum(i["handover/starved"] for i in infos) > 0, "the fallback had its turn"
    for commands, _ in found:
        assert np.abs(np.diff(commands, axis=0)).max() <= limit * env.control_dt
    assert max(i["handover/peak_jerk"] for i in infos) <= limit
    in_time = sum(i["handover/limited"] == 0 for i in infos) / len(infos)
    assert in_time > 0.5, "a blend that fits is the rule"


def test_a_filter_inside_may_break_the_limit_and_then_it_shows():
    """What is sent keeps it; what is executed is the filter's, and that is what is reported."""
    recorder = Recorder(sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(6.0)]))
    limit = 4.0
    env = ChunkHandover(recorder, 24, 8, 2, rate_limit=limit)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    above, last = 0, None
    for chunk, _ in zip(smooth_chunks(env, rng), range(6), strict=False):
        info = env.step(chunk)[4]
        executed = np.array([i["executed_action"] for i in recorder.infos[-8:]], np.float64)
        whole = executed if last is None else np.vstack([last, executed])
        last = executed[-1:]
        peak = np.abs(np.diff(whole, axis=0)).max() / env.control_dt
        assert info["handover/peak_jerk"] == pytest.approx(peak)
        above += peak > limit
    assert np.abs(np.diff(recorder.commands, axis=0)).max() <= limit * env.control_dt
    assert above > 0
