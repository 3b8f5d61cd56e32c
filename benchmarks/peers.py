"""Projections and whole filter calls beside those of other packages: the same problems, in turn, in one process.

`bench` makes the rows of its table of these. CBFpy's is its jitted `safety_filter`; ours is the whole `env.step` of
an env whose own step does nothing.
"""

import importlib.util
import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import qpsolvers

import safe_wrappers as sw
from benchmarks.tables import paired_us

SIZES = ((2, 1), (2, 8), (6, 12), (17, 40))
"""Controls and rows: a point robot, several discs, a runner, a humanoid."""
WALL, BRAKE, ALPHA = 1.0, 1.0, 2.0

Problem = tuple[np.ndarray, ...]
Times = dict[str, float]
"""Microseconds by name; ours first."""


def problems(m: int, k: int, active: bool, count: int = 200) -> list[Problem]:
    """Feasible problems whose nominal violates some row, or none."""
    rng = np.random.default_rng(0)
    found: list[Problem] = []
    while len(found) < count:
        inside = rng.uniform(-0.5, 0.5, m)
        normals = rng.normal(size=(k, m))
        offsets = normals @ inside + rng.uniform(0.01, 0.5, k)
        nominal = rng.uniform(-1.0, 1.0, m)
        if (normals @ nominal > offsets).any():
            offsets = offsets if active else np.maximum(offsets, normals @ nominal)
            found.append((nominal, normals, offsets, -np.ones(m), np.ones(m)))
    return found


def cycling(call: Callable[..., Any], items: list[Any]) -> Callable[[], Any]:
    """A callable that takes the next item at every call."""
    rest = itertools.cycle(items)
    return lambda: call(*next(rest))


def by_qpsolvers(solver: str, *problem: np.ndarray) -> Any:
    """The same projection written for qpsolvers."""
    u, a, b, lo, hi = problem
    return qpsolvers.solve_qp(np.eye(u.size), -u, a, b, lb=lo, ub=hi, solver=solver)


def projections(m: int, k: int, active: bool) -> Times:
    """One `project` beside qpsolvers' backends."""
    items = problems(m, k, active)
    others = {f"qpsolvers+{s}": partial(by_qpsolvers, s) for s in ("daqp", "clarabel")}
    calls = {"project": sw.project} | others
    return paired_us({name: cycling(call, items) for name, call in calls.items()}, rounds=20)


class DoubleIntegrator(gym.Env[np.ndarray, np.ndarray]):
    """Position and velocity; whoever steps it sets `x`, and `step` does nothing but answer."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    x = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Nothing to reset."""
        return self.x, {}

    def step(self, action: np.ndarray) -> Any:
        """Nothing to compute: what is timed is the filter."""
        return self.x, 0.0, False, False, {}


def wall_filter(env: gym.Env[Any, Any]) -> sw.CBFActionFilter:
    """`h = D - v^2 / (2 a)` against a wall."""
    effect = np.array([[0.0], [1.0]])
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 0.0]), g=lambda x: effect, state=lambda e: e.x, control_dt=0.02
    )
    barrier = sw.constraints.Barrier(
        lambda x: WALL - x[0] - x[1] ** 2 / (2.0 * BRAKE),
        alpha=ALPHA,
    )
    filtered = sw.CBFActionFilter(env, [barrier], plant=plant)
    filtered.reset()
    return filtered


def states(active: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    """States and nominal controls that the barrier changes, or does not."""
    rng = np.random.default_rng(0)
    found = []
    while len(found) < 256:
        x, u = np.array([rng.uniform(-0.5, 0.6), rng.uniform(0.05, 0.8)]), rng.uniform(0.0, 1.0, 1)
        left = ALPHA * (WALL - x[0] - x[1] ** 2 / (2.0 * BRAKE)) - x[1]
        if left > 0.0 and (x[1] / BRAKE * u[0] > left + 1e-3) == active:
            found.append((x, u))
    return found


def by_cbfpy() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """State and nominal control to CBFpy's control; compiled."""
    import jax
    import jax.numpy as jnp
    from cbfpy import CBF, CBFConfig

    class WallConfig(CBFConfig):  # type: ignore[misc]
        """The same problem."""

        def __init__(self) -> None:
            super().__init__(n=2, m=1, u_min=[-1.0], u_max=[1.0])

        def f(self, z: Any) -> Any:
            return jnp.array([z[1], 0.0])

        def g(self, z: Any) -> Any:
            return jnp.array([[0.0], [1.0]])

        def h_1(self, z: Any) -> Any:
            return jnp.array([WALL - z[0] - z[1] ** 2 / (2.0 * BRAKE)])

        def alpha(self, h: Any) -> Any:
            return ALPHA * h

    jax.config.update("jax_platform_name", "cpu")
    made = CBF.from_config(WallConfig())
    return lambda x, u: np.asarray(made.safety_filter(x, u))


def filter_calls(active: bool) -> Times:
    """A whole filter call on the double integrator, beside CBFpy's where that is installed (the extra `bench`)."""
    env, items = DoubleIntegrator(), states(active)
    ours = wall_filter(env)

    def call(x: np.ndarray, u: np.ndarray) -> Any:
        env.x = x
        return ours.step(u)

    sides = {"whole env.step": cycling(call, items)}
    if importlib.util.find_spec("cbfpy"):
        theirs = by_cbfpy()
        for x, u in items:  # CBFpy relaxes its constraint and stops at 1e-3
            assert np.abs(call(x, u)[4]["executed_action"] - theirs(x, u)).max() < 0.05
        sides["CBFpy"] = cycling(theirs, items)
    return paired_us(sides, rounds=20)
