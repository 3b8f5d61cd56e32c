"""SB3's vector envs, unrolled into episodes and compared with those by hand."""

import numpy as np
from single_loops import Episode, Step, assert_same_episodes


def unroll(envs, actions, *, seed, steps, options=None):
    """The episodes of every sub-env of an SB3 vector env, which resets within the step."""
    n = envs.num_envs
    envs.seed(seed)
    envs.set_options(options)
    observations = envs.reset()
    episodes = [[Episode(o, told)] for o, told in zip(observations, envs.reset_infos, strict=True)]
    for _ in range(steps):
        proposed = [actions(i, len(e) - 1, len(e[-1].steps)) for i, e in enumerate(episodes)]
        observations, rewards, dones, infos = envs.step(np.stack(proposed))
        assert len(infos) == n
        for i in range(n):
            info = dict(infos[i])
            truncated = info.pop("TimeLimit.truncated")
            assert ("terminal_observation" in info) == dones[i] == ("episode" in info)
            last = info.pop("terminal_observation") if dones[i] else observations[i]
            episodes[i][-1].steps.append(Step(last, rewards[i], dones[i] and not truncated, truncated, info))
            if dones[i]:
                episodes[i].append(Episode(observations[i], envs.reset_infos[i]))
    return episodes


def without_time(episodes):
    """Monitor writes the wall-clock time of an episode's end: the one thing that may differ."""
    for episode in episodes:
        for step in episode.steps:
            if "episode" in step.info:
                step.info["episode"].pop("t", None)
    return episodes


def assert_same(got, wanted, kind, name=""):
    if kind == "dummy":  # its rewards are float32
        for episode in wanted:
            for step in episode.steps:
                step.reward = np.float32(step.reward)
    return assert_same_episodes(without_time(got), without_time(wanted), name, types=True)
