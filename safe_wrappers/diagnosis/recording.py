"""Recordings: what an env did under a driver, step by step."""

import inspect
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import check_timing, one_reward, wrappers_of
from safe_wrappers.wrappers.monitors import BalanceMonitor, ContactMonitor

Env = gym.Env[Any, Any]
Driver = Callable[[Any], Any]
"""Gives an action for an observation; one that has `reset()` is told so that an episode begins."""
NOT_REPLAYED = "most control steps, made once more, end elsewhere: the env changes its state between substeps"
_DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]
PULSE_STEPS = 15
"""For which the attacking driver holds a corner of the action space."""

LONGEST_HORIZON = 60
"""Control steps of a proposed horizon at most: each costs a forecast of as many."""


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
    reset = getattr(policy, "reset", None)
    if callable(reset):
        try:
            inspect.signature(reset).bind()
        except TypeError as error:
            raise ConfigurationError(
                f"the policy's reset is called without arguments where an episode begins, and takes "
                f"{inspect.signature(reset)}: give them defaults, or leave reset away"
            ) from error
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
        rewards: Of each step, shape (k,).
        infos: Of each step, with those of a contact and a balance monitor, where the env allows them.
        first: The first steps of episodes, shape (k,).
        terminated: Shape (k,).
        executed: That the unwrapped env was given, shape (k, m).
        controls: The model's control that each step left, shape (k, nu); empty without MuJoCo.
        qpos: After each step, shape (k, nq); likewise.
        qvel: Shape (k, nv); likewise.
        contacts: After each step, pairs of geoms that touch, ids; likewise.
        struck: Names of the two bodies with the largest force of each step; None where there was none.
        shown: The observation after each step, as the driver got it; None where it is no flat array.
        answered: As the unwrapped env gave it; likewise.
        port_efforts: That acted at the env's port in each step, as it publishes them, shape (k, p), N; else empty.
        control_dt: Control interval, s; NaN where nothing says it.
        diverged: Whether MuJoCo has found numbers in a step that are not finite, and has reset its data, shape (k,).
        repeats: Asked twice with the first observation, the driver has given the same action.
    """

    actions: Array
    rewards: Array
    infos: list[dict[str, Any]]
    first: np.ndarray
    terminated: np.ndarray
    executed: Array
    controls: Array
    qpos: Array
    qvel: Array
    contacts: list[set[tuple[int, int]]]
    struck: list[tuple[str, str] | None]
    shown: list[Array | None]
    answered: list[Array | None]
    port_efforts: Array
    control_dt: float
    diverged: np.ndarray
    repeats: bool

    def of_info(self, key: str) -> Array:
        """A number of each step's info, shape (k,); NaN where a step does not report it."""
        return np.array([float(info.get(key, np.nan)) for info in self.infos])


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


class _Spy(gym.Wrapper[Any, Any, Any, Any]):
    """Remembers the last action that the unwrapped env was given, and its observation.

    It is a wrapper, and no function on the env, so that envs can be copied with it.
    """

    given: tuple[Array, Array | None]

    def step(self, action: Any) -> Any:
        taken = np.array(action, dtype=float)
        answer = self.env.step(action)
        self.given = taken, _kept(answer[0])
        return answer


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


def _kept(observation: Any) -> Array | None:
    """A copy, since an env may reuse its arrays."""
    flat = isinstance(observation, np.ndarray) and observation.ndim == 1
    return observation.astype(np.float64) if flat else None


def _warnings(data: mujoco.MjData) -> int:
    return int(sum(data.warning[kind].number for kind in _DIVERGED))


def record(env: Env, driver: Driver, steps: int, seed: int) -> Recording:
    """Drive the env for so many control steps, episode after episode.

    Raises:
        ConfigurationError: The driver gave an action that is not finite; the env never gets it.
    """
    found, env = physics(env), monitored(env)
    monitor = next((one for one in wrappers_of(env) if isinstance(one, ContactMonitor)), None)
    rows: list[tuple[Any, ...]] = []
    states: list[tuple[Any, ...]] = []
    contacts: list[set[tuple[int, int]]] = []
    diverged: list[bool] = []
    efforts: list[Array] = []
    publishes = env.has_wrapper_attr("port_effort_acted")
    observation, over, episode, control_dt, repeats = None, True, 0, _declared_dt(env), False
    begin = getattr(driver, "reset", lambda: None)
    with _spied(env) as (env, spy), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of what the figures count
        for _ in range(steps):
            first = over
            if first:
                observation, _ = env.reset(seed=seed + episode)
                begin()
                episode += 1
            if not rows:
                repeats = np.array_equal(driver(observation), driver(observation))
                begin()  # what it remembers of being asked
            action = np.asarray(driver(observation))
            if not np.isfinite(action).all():
                raise ConfigurationError(
                    f"the policy's action in control step {len(rows)} is not finite: {action}; the env was not "
                    "given it"
                )
            before = (found[1].time, _warnings(found[1])) if found is not None else (0.0, 0)
            observation, reward, terminated, truncated, info = env.step(action)
            struck = None if monitor is None else monitor.peak_bodies
            rows.append(
                (
                    action.astype(float),
                    one_reward(reward, "diagnose"),
                    info,
                    first,
                    terminated,
                    *spy.given,
                    struck,
                    _kept(observation),
                )
            )
            if publishes:
                efforts.append(np.array(env.get_wrapper_attr("port_effort_acted"), dtype=float))
            over = bool(terminated or truncated)
            if found is not None:
                data = found[1]
                new = _warnings(data) > before[1]
                diverged.append(new)
                control_dt = control_dt if new else data.time - before[0]
                states.append((data.ctrl.copy(), data.qpos.copy(), data.qvel.copy()))
                touching = data.contact.geom[: data.ncon][data.contact.dist[: data.ncon] <= 0.0]
                contacts.append({(int(a), int(b)) for a, b in touching})
    actions, rewards, infos, starts, ends, executed, answered, pairs, shown = zip(*rows, strict=True)
    controls, qpos, qvel = zip(*states, strict=True) if states else ((), (), ())
    return Recording(
        np.array(actions),
        np.array(rewards),
        list(infos),
        np.array(starts),
        np.array(ends),
        np.array(executed),
        np.array(controls),
        np.array(qpos),
        np.array(qvel),
        contacts,
        list(pairs),
        list(shown),
        list(answered),
        np.array(efforts),
        control_dt,
        np.array(diverged),
        repeats,
    )
