"""Recordings: what an env did under a driver, step by step."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import check_timing
from safe_wrappers.wrappers.balance_monitor import BalanceMonitor
from safe_wrappers.wrappers.contact_monitor import ContactMonitor

Env = gym.Env[Any, Any]
Driver = Callable[[Any], Any]
"""Gives an action for an observation."""
PULSE_STEPS = 15
"""For which the attacking driver holds a corner of the action space."""


class Predicts(Protocol):
    """A policy as SB3 has it."""

    def predict(self, observation: Any, deterministic: bool = True) -> tuple[Any, Any]:
        """The action, and a state."""


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


def policy_driver(policy: Predicts | Driver) -> Driver:
    """A function of the observation, or a model with `predict`, asked deterministically."""
    predict = getattr(policy, "predict", None)
    if predict is not None:
        return lambda observation: predict(observation, deterministic=True)[0]
    if not callable(policy):
        raise ConfigurationError(
            "policy is a function of the observation, or has predict(observation, deterministic=True); "
            f"got {policy!r}"
        )
    return policy


def box(env: Env) -> tuple[Array, Array]:
    """The ends of the action space; where it has none, -1 and 1."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise UnsupportedEnvError(f"diagnose needs a Box action space of shape (m,), got {space}")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    return np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)


@dataclass
class Recording:
    """What one driver did; k control steps.

    Attributes:
        actions: That were proposed, shape (k, m).
        infos: Of each step, with those of a contact and a balance monitor, where the env allows them.
        first: The first steps of episodes, shape (k,).
        terminated: Shape (k,).
        commands: The model's control that each step left, shape (k, nu); empty without MuJoCo.
        qpos: After each step, shape (k, nq); likewise.
        qvel: Shape (k, nv); likewise.
        contacts: After each step, pairs of geoms that touch, ids; likewise.
        control_dt: Control interval, s; NaN where nothing says it.
    """

    actions: Array
    infos: list[dict[str, Any]]
    first: np.ndarray
    terminated: np.ndarray
    commands: Array
    qpos: Array
    qvel: Array
    contacts: list[set[tuple[int, int]]]
    control_dt: float

    def of_info(self, key: str) -> Array:
        """A number of each step's info, shape (k,); NaN where a step does not report it."""
        return np.array([float(info.get(key, np.nan)) for info in self.infos])


def physics(env: Env) -> tuple[mujoco.MjModel, mujoco.MjData] | None:
    """MuJoCo's model and data of an env; None where it has none."""
    raw: Any = env.unwrapped
    model, data = getattr(raw, "model", None), getattr(raw, "data", None)
    return (model, data) if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData) else None


def monitored(env: Env) -> Env:
    """The env in a contact and a balance monitor, where it allows them."""
    for monitor in (ContactMonitor, BalanceMonitor):
        try:
            env = monitor(env)
        except ConfigurationError:  # no MuJoCo, nothing that stands, or a wrapper inside whose step is many
            continue
    return env


def _declared_dt(env: Env) -> float:
    try:
        return check_timing(env, None)
    except ConfigurationError:
        return math.nan


def record(env: Env, driver: Driver, steps: int, seed: int) -> Recording:
    """Drive the env for so many control steps, episode after episode."""
    env, found = monitored(env), physics(env)
    taken: dict[str, list[Any]] = {name: [] for name in ("actions", "infos", "first", "terminated")}
    seen: dict[str, list[Any]] = {name: [] for name in ("commands", "qpos", "qvel", "contacts")}
    observation, over, episode, control_dt = None, True, 0, _declared_dt(env)
    for _ in range(steps):
        if over:
            observation, _ = env.reset(seed=seed + episode)
            episode += 1
        action = driver(observation)
        before_s = found[1].time if found is not None else 0.0
        observation, _, terminated, truncated, info = env.step(action)
        for name, value in (
            ("actions", np.array(action, dtype=float)), ("infos", info), ("first", over), ("terminated", terminated)
        ):  # fmt: skip
            taken[name].append(value)
        over = bool(terminated or truncated)
        if found is not None:
            data = found[1]
            control_dt = data.time - before_s
            seen["commands"].append(data.ctrl.copy())
            seen["qpos"].append(data.qpos.copy())
            seen["qvel"].append(data.qvel.copy())
            touching = data.contact.geom[: data.ncon][data.contact.dist[: data.ncon] <= 0.0]
            seen["contacts"].append({(int(a), int(b)) for a, b in touching})
    arrays = {name: np.array(values) for name, values in seen.items() if name != "contacts"}
    return Recording(
        np.array(taken["actions"]),
        taken["infos"],
        np.array(taken["first"]),
        np.array(taken["terminated"]),
        contacts=seen["contacts"],
        control_dt=control_dt,
        **arrays,
    )
