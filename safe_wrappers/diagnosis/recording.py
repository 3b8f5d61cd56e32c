"""Recordings: what an env did under a driver, step by step."""

import itertools
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.errors import Array, ConfigurationError, UnsupportedEnvError, finite_action
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.monitors import BalanceMonitor, ContactMonitor

Env = gym.Env[Any, Any]
Driver = Callable[[Any], Any]
"""Gives an action for an observation; one that has `reset()` is told so that an episode begins."""
_DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]


class NotMeasuredError(Exception):
    """Why a symptom cannot be measured in an env; never leaves this package."""


def random_driver(env: Env, seed: int) -> Driver:
    """Uniform random actions."""
    rng, (low, high) = np.random.default_rng(seed), box(env)
    return lambda observation: rng.uniform(low, high).astype(env.action_space.dtype)


def attacking_driver(env: Env, seed: int) -> Driver:
    """Random corners of the action space, each held for 15 steps."""
    rng, (low, high) = np.random.default_rng(seed), box(env)
    corners = (np.where(rng.random(low.shape) < 0.5, low, high) for _ in itertools.count())
    actions = (corner.astype(env.action_space.dtype) for corner in corners for _ in range(15))
    return lambda observation: next(actions)


def policy_driver(policy: Any) -> Driver:
    """A function of the observation, or a model with `predict`, asked deterministically."""
    predict = getattr(policy, "predict", None)
    if predict is not None:
        return lambda observation: predict(observation, deterministic=True)[0]
    if not callable(policy):
        raise ConfigurationError(
            "policy is a function of the observation, or has predict(observation, deterministic=True); "
            f"got {policy!r}"
        )
    return cast(Driver, policy)


def box(env: Env) -> tuple[Array, Array]:
    """The ends of the action space; where it has none, -1 and 1."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise UnsupportedEnvError(f"diagnose needs a Box action space of shape (m,), got {space}")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    return np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)


@dataclass
class Recording:
    """What one driver did in k control steps. What MuJoCo says is empty for an env without it."""

    env: Env
    infos: list[dict[str, Any]]  # with those of a contact and a balance monitor, where the env allows them
    struck: list[tuple[str, str] | None]  # bodies with the largest force
    first: np.ndarray  # steps of episodes, shape (k,)
    terminated: np.ndarray
    executed: Array  # actions that the unwrapped env was given, shape (k, m)
    qpos: Array  # after each step, shape (k, nq)
    qvel: Array
    diverged: np.ndarray  # MuJoCo has found numbers that are not finite, and has reset its data, shape (k,)

    def of_info(self, key: str) -> Array:
        """A number of each step's info, shape (k,); NaN where a step does not report it."""
        return np.array([float(info.get(key, np.nan)) for info in self.infos])

    @property
    def model(self) -> mujoco.MjModel | None:
        """MuJoCo's model of the env; None where it has none."""
        model = getattr(self.env.unwrapped, "model", None)
        return model if isinstance(model, mujoco.MjModel) else None

    @property
    def needed_model(self) -> mujoco.MjModel:
        """The same; `NotMeasuredError` where there is none."""
        if (model := self.model) is None:
            raise NotMeasuredError("the env has no MuJoCo model")
        return model

    def check_replays(self) -> None:
        """`NotMeasuredError` where the figures of the monitors say nothing of this env."""
        partial = max(np.mean(self.of_info(f"{monitor}/partial") > 0.0) for monitor in ("contact", "balance"))
        if partial > 0.5:
            raise NotMeasuredError(
                "most control steps, made once more, end elsewhere: the env changes its state between substeps"
            )

    @property
    def braking_horizon(self) -> int:
        """Control steps in which the speeds that were seen are braked, by the changes of speed that were usual."""
        change = np.abs(np.diff(self.qvel, axis=0)).max(axis=1)[~self.first[1:]]
        usual = float(np.median(change)) if change.size else 0.0
        # At most 60: each costs a forecast of as many.
        return int(np.clip(np.ceil(np.abs(self.qvel).max() / max(usual, 1e-9)), 5, 60))


class _Spy(gym.Wrapper[Any, Any, Any, Any]):
    """Remembers the last action that the unwrapped env was given; a wrapper, so that envs can be copied with it."""

    given: Array

    def step(self, action: Any) -> Any:
        self.given = np.array(action, dtype=float)
        return self.env.step(action)


@contextmanager
def _spied(env: gym.Wrapper[Any, Any, Any, Any]) -> Iterator[_Spy]:
    """A spy as the env's innermost wrapper, as long as this lasts."""
    *_, innermost = wrappers_of(env)
    innermost.env = spy = _Spy(env.unwrapped)
    try:
        yield spy
    finally:
        innermost.env = spy.env


def record(env: Env, driver: Driver, steps: int, seed: int) -> Recording:
    """Drive the env for so many control steps, episode after episode.

    Raises:
        ActionError: The driver gave an action of another shape, or one that is not finite; the env never gets it.
    """
    data, size = getattr(env.unwrapped, "data", None), math.prod(env.action_space.shape or ())
    data = data if isinstance(data, mujoco.MjData) else None
    contacts, monitored = None, gym.Wrapper(env)
    with suppress(ConfigurationError):  # no MuJoCo, nothing that stands, a wrapper whose step is many
        contacts = monitored = ContactMonitor(monitored)
        monitored = BalanceMonitor(monitored)
    rows: list[tuple[Any, ...]] = []
    observation, over, episode = None, True, 0
    with _spied(monitored) as spy, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of what the figures count
        for _ in range(steps):
            first = over
            if first:
                observation, _ = monitored.reset(seed=seed + episode)
                getattr(driver, "reset", lambda: None)()
                episode += 1
            action = finite_action(driver(observation), size)
            before = _divergences(data)
            observation, _, terminated, truncated, info = monitored.step(action)
            over = bool(terminated or truncated)
            struck = None if contacts is None else contacts.peak_bodies
            diverged = _divergences(data) > before
            state = (np.empty(0), np.empty(0)) if data is None else (data.qpos.copy(), data.qvel.copy())
            rows.append((info, struck, first, terminated, spy.given, *state, diverged))
    infos, bodies, *arrays = zip(*rows, strict=True)
    return Recording(env, list(infos), list(bodies), *map(np.array, arrays))


def _divergences(data: mujoco.MjData | None) -> int:
    return 0 if data is None else int(sum(data.warning[kind].number for kind in _DIVERGED))
