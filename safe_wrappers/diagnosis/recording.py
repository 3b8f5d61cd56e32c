"""Recordings: what an env did under a driver, step by step."""

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array, finite_action
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import check_timing, wrappers_of
from safe_wrappers.wrappers.monitors import BalanceMonitor, ContactMonitor

Env = gym.Env[Any, Any]
Driver = Callable[[Any], Any]
"""Gives an action for an observation; one that has `reset()` is told so that an episode begins."""
_DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]
PULSE_STEPS = 15
"""For which the attacking driver holds a corner of the action space."""
LONGEST_HORIZON = 60
"""Control steps of a proposed horizon at most: each costs a forecast of as many."""


def random_driver(env: Env, seed: int) -> Driver:
    """Uniform random actions."""
    rng, (low, high) = np.random.default_rng(seed), box(env)
    return lambda observation: rng.uniform(low, high).astype(env.action_space.dtype)


def attacking_driver(env: Env, seed: int) -> Driver:
    """Random corners of the action space, each held for 15 steps."""
    rng, (low, high) = np.random.default_rng(seed), box(env)
    held: dict[str, Any] = {"left": 0}

    def act(observation: Any) -> Any:
        if held["left"] == 0:
            held.update(left=PULSE_STEPS, action=np.where(rng.random(low.shape) < 0.5, low, high))
        held["left"] -= 1
        return held["action"].astype(env.action_space.dtype)

    return act


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
    driver: Driver = policy
    return driver


def box(env: Env) -> tuple[Array, Array]:
    """The ends of the action space; where it has none, -1 and 1."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise UnsupportedEnvError(f"diagnose needs a Box action space of shape (m,), got {space}")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    return np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)


@dataclass
class Recording:
    """What one driver did; k control steps. What MuJoCo says is empty for an env without it.

    Attributes:
        infos: Of each step, with those of a contact and a balance monitor, where the env allows them.
        first: The first steps of episodes, shape (k,).
        terminated: Shape (k,).
        executed: The actions that the unwrapped env was given, shape (k, m).
        struck: Names of the two bodies with the largest force of each step; None where there was none.
        controls: The model's control that each step left, shape (k, nu).
        qpos: After each step, shape (k, nq).
        qvel: Shape (k, nv).
        contacts: After each step, pairs of geoms that touch, ids.
        diverged: Whether MuJoCo has found numbers in a step that are not finite, and has reset its data, shape (k,).
        control_dt: Control interval, s; NaN where nothing says it.
    """

    infos: list[dict[str, Any]]
    first: np.ndarray
    terminated: np.ndarray
    executed: Array
    struck: list[tuple[str, str] | None]
    controls: Array
    qpos: Array
    qvel: Array
    contacts: list[set[tuple[int, int]]]
    diverged: np.ndarray
    control_dt: float

    def of_info(self, key: str) -> Array:
        """A number of each step's info, shape (k,); NaN where a step does not report it."""
        return np.array([float(info.get(key, np.nan)) for info in self.infos])

    @property
    def not_replayed(self) -> str:
        """Why a monitor's figures say nothing of this env; "" where they do."""
        partial = max(np.mean(self.of_info(f"{monitor}/partial") > 0.0) for monitor in ("contact", "balance"))
        why = "most control steps, made once more, end elsewhere: the env changes its state between substeps"
        return why if partial > 0.5 else ""


def braking_horizon(recording: Recording) -> int:
    """Control steps in which the speeds that were seen are braked, by the changes of speed that were usual."""
    change = np.abs(np.diff(recording.qvel, axis=0)).max(axis=1)[~recording.first[1:]]
    usual = float(np.median(change)) if change.size else 0.0
    return int(np.clip(np.ceil(np.abs(recording.qvel).max() / max(usual, 1e-9)), 5, LONGEST_HORIZON))


def physics(env: Env) -> tuple[mujoco.MjModel, mujoco.MjData] | None:
    """MuJoCo's model and data of an env; None where it has none."""
    raw: Any = env.unwrapped
    model, data = getattr(raw, "model", None), getattr(raw, "data", None)
    return (model, data) if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData) else None


class _Spy(gym.Wrapper[Any, Any, Any, Any]):
    """Remembers the last action that the unwrapped env was given; a wrapper, so that envs can be copied with it."""

    given: Array

    def step(self, action: Any) -> Any:
        self.given = np.array(action, dtype=float)
        return self.env.step(action)


@contextmanager
def _spied(env: Env) -> Iterator[tuple[Env, _Spy]]:
    """The env with a spy as its innermost wrapper, as long as this lasts."""
    spy = _Spy(env.unwrapped)
    innermost = next((layer for layer in wrappers_of(env) if layer.env is env.unwrapped), None)
    if innermost is None:
        yield spy, spy
        return
    innermost.env = spy
    try:
        yield env, spy
    finally:
        innermost.env = spy.env


def _monitored(env: Env) -> tuple[Env, ContactMonitor | None]:
    """The env in a contact and a balance monitor, where it allows them."""
    contacts = None
    for monitor in (ContactMonitor, BalanceMonitor):
        with suppress(
            ConfigurationError
        ):  # no MuJoCo, nothing that stands, or a wrapper inside whose step is many
            env = monitor(env)
        contacts = env if isinstance(env, ContactMonitor) else contacts
    return env, contacts


def record(env: Env, driver: Driver, steps: int, seed: int) -> Recording:
    """Drive the env for so many control steps, episode after episode.

    Raises:
        ActionError: The driver gave an action of another shape, or one that is not finite; the env never gets it.
    """
    found, size = physics(env), math.prod(env.action_space.shape or ())
    env, monitor = _monitored(env)
    rows: list[tuple[Any, ...]] = []
    states: list[tuple[Any, ...]] = []
    observation, over, episode, control_dt = None, True, 0, math.nan
    with suppress(ConfigurationError):
        control_dt = check_timing(env, None)
    with _spied(env) as (env, spy), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of what the figures count
        for _ in range(steps):
            first = over
            if first:
                observation, _ = env.reset(seed=seed + episode)
                getattr(driver, "reset", lambda: None)()
                episode += 1
            action = finite_action(driver(observation), size)
            before = (0.0, 0) if found is None else (found[1].time, _warnings(found[1]))
            observation, _, terminated, truncated, info = env.step(action)
            struck = None if monitor is None else monitor.peak_bodies
            rows.append((info, first, terminated, spy.given, struck))
            over = bool(terminated or truncated)
            if found is not None:
                data = found[1]
                diverged = _warnings(data) > before[1]
                control_dt = control_dt if diverged else data.time - before[0]
                touching = data.contact.geom[: data.ncon][data.contact.dist[: data.ncon] <= 0.0]
                pairs = {(int(a), int(b)) for a, b in touching}
                states.append((data.ctrl.copy(), data.qpos.copy(), data.qvel.copy(), pairs, diverged))
    infos, starts, ends, executed, bodies = zip(*rows, strict=True)
    controls, qpos, qvel, contacts, bad = zip(*states, strict=True) if states else ((),) * 5
    return Recording(
        list(infos), np.array(starts), np.array(ends), np.array(executed), list(bodies),
        np.array(controls), np.array(qpos), np.array(qvel), list(contacts), np.array(bad), control_dt,
    )  # fmt: skip


def _warnings(data: mujoco.MjData) -> int:
    return int(sum(data.warning[kind].number for kind in _DIVERGED))
