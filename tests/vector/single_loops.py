"""The oracle: single envs driven by hand, every episode on a stack that has never run before.

A vector env's stream is unrolled into the episodes that it was made of, whatever its autoreset mode; these must be,
bit for bit, the episodes by hand. Since each of those has a new filter and a new recorder, nothing that should have
been forgotten at a reset can hide in both.
"""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode


@dataclass
class Step:
    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


@dataclass
class Episode:
    observation: np.ndarray
    info: dict[str, Any]
    steps: list[Step] = field(default_factory=list)


def script(space, seed=0, drive=None):
    """Actions by sub-env, episode and step, so that every mode plays the same episodes.

    Bang-bang, held for three steps; the first action of every later episode is not finite, so that the fallback
    "hold" shows what the filter remembers. `drive` is the share of ones in the first control.
    """

    def action(i, k, t):
        if k and not t:
            return np.full(space.shape, np.nan, space.dtype)
        rng = np.random.default_rng([seed, i, k, t // 3])
        signs = rng.choice([-1.0, 1.0], space.shape)
        if drive is not None:
            signs[0] = 1.0 if rng.random() < drive else -1.0
        return np.where(signs > 0, space.high, space.low).astype(space.dtype)

    return action


def _generators(env):
    """The wrappers' own random numbers, the outermost first."""
    inner, found = env, []
    while isinstance(inner, gym.Wrapper):
        found += [(inner, name) for name in ("random", "_random") if name in vars(inner)]
        inner = inner.env
    return found


def by_hand(make, actions, i, *, seed, steps, options=None):
    """The episodes of sub-env i: reset where one ends, on a new env that carries on the old one's generators."""
    env = make(i)
    observation, info = env.reset(seed=seed, options=options)
    episodes = [Episode(observation, info)]
    for _ in range(steps):
        now = episodes[-1]
        observation, reward, terminated, truncated, info = env.step(
            actions(i, len(episodes) - 1, len(now.steps))
        )
        now.steps.append(Step(observation, float(reward), terminated, truncated, info))
        if terminated or truncated:
            used, env = env, make(i)
            env.unwrapped.np_random = used.unwrapped.np_random
            for (new, name), (old, _) in zip(_generators(env), _generators(used), strict=True):
                setattr(new, name, getattr(old, name))
            if hasattr(used.unwrapped, "ends"):
                env.unwrapped.ends = used.unwrapped.ends
            episodes.append(Episode(*env.reset()))
    return episodes


def rows(infos, n):
    """A vector env's infos, one dict per sub-env, by the masks; refuses what has no mask or a vague dtype."""
    told: list[dict[str, Any]] = [{} for _ in range(n)]
    for key, values in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos[f"_{key}"]
        assert mask.dtype == np.bool_ and mask.shape == (n,), key
        if isinstance(values, dict):
            values = rows(values, n)
        else:
            assert len(values) == n, key
            assert values.dtype != object or key == "final_obs", f"{key} became an array of objects"
        for i in np.flatnonzero(mask):
            told[i][key] = values[i]
    return told


def unroll(envs, actions, *, seed, steps, options=None):
    """The episodes of every sub-env of a Gymnasium vector env, in any autoreset mode."""
    mode, n = envs.metadata["autoreset_mode"], envs.num_envs
    observations, infos = envs.reset(seed=seed, options=options)
    episodes = [[Episode(o, told)] for o, told in zip(observations, rows(infos, n), strict=True)]
    resets = np.zeros(n, bool)
    for _ in range(steps):
        proposed = [actions(i, len(e) - 1, len(e[-1].steps)) for i, e in enumerate(episodes)]
        # What is sent to a sub-env that will only reset must not matter at all.
        proposed = [np.full_like(a, np.inf) if resets[i] else a for i, a in enumerate(proposed)]
        observations, rewards, terminated, truncated, infos = envs.step(np.stack(proposed))
        ended = terminated | truncated
        for i, told in enumerate(rows(infos, n)):
            if resets[i]:
                assert rewards[i] == 0.0 and not ended[i]
                episodes[i].append(Episode(observations[i], told))
                continue
            if mode is AutoresetMode.SAME_STEP and ended[i]:
                final = told.pop("final_obs"), told.pop("final_info")
                episodes[i][-1].steps.append(
                    Step(final[0], rewards[i], terminated[i], truncated[i], final[1])
                )
                episodes[i].append(Episode(observations[i], told))
            else:
                episodes[i][-1].steps.append(
                    Step(observations[i], rewards[i], terminated[i], truncated[i], told)
                )
        if mode is AutoresetMode.NEXT_STEP:
            resets = ended
        elif mode is AutoresetMode.DISABLED and ended.any():
            again, infos = envs.reset(options={"reset_mask": ended})
            for i, told in enumerate(rows(infos, n)):
                if ended[i]:
                    episodes[i].append(Episode(again[i], told))
                else:
                    assert told == {} and again[i].tobytes() == observations[i].tobytes()
    return episodes


def unroll_sb3(envs, actions, *, seed, steps, options=None):
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


def assert_same_info(got, wanted, where, types=False):
    """The same keys, and behind each the same dtype, shape and bits; with `types` the same Python types, too."""
    assert got.keys() == wanted.keys(), f"{where}: {sorted(got.keys() ^ wanted.keys())}"
    for key, value in wanted.items():
        if isinstance(value, dict):
            assert_same_info(got[key], value, f"{where}, {key}", types)
            continue
        have, want = np.asarray(got[key]), np.asarray(value)
        assert have.dtype == want.dtype, f"{where}, {key}: {have.dtype}, not {want.dtype}"
        assert have.shape == want.shape, f"{where}, {key}: {have.shape}, not {want.shape}"
        assert have.tobytes() == want.tobytes(), f"{where}, {key}: {have}, not {want}"
        assert not types or type(got[key]) is type(value), f"{where}, {key}: {type(got[key])}"


def assert_same_episodes(got, wanted, name="", types=False):
    """All that was unrolled is what was done by hand, which may go on for longer; returns how many were whole."""
    assert len(got) <= len(wanted)
    for k, (mine, theirs) in enumerate(zip(got, wanted, strict=False)):
        where = f"{name}episode {k}"
        assert mine.observation.tobytes() == theirs.observation.tobytes(), f"{where}, reset"
        assert_same_info(mine.info, theirs.info, f"{where}, reset", types)
        assert len(mine.steps) == len(theirs.steps) or k == len(got) - 1, where
        for t, (step, want) in enumerate(zip(mine.steps, theirs.steps, strict=False)):
            at = f"{where}, step {t}"
            assert step.observation.tobytes() == want.observation.tobytes(), at
            assert step.reward == want.reward, at
            assert (step.terminated, step.truncated) == (want.terminated, want.truncated), at
            assert_same_info(step.info, want.info, at, types)
    return len(got) - 1
