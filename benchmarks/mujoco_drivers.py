"""Drivers that make life hard for a filter on MuJoCo robots; each is a function of the unwrapped env, seeded.

`random`, `bang_bang` and `pulse` know nothing. The others read the true state and go for one limit.
"""

from collections.abc import Callable, Iterator
from itertools import cycle
from typing import Any

import mujoco
import numpy as np
from scipy.linalg import solve_discrete_are

from benchmarks.drivers import Action, Driver, Maker, held, stepwise
from benchmarks.judges import stepped, wall_geoms

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


def _box(env: Any) -> tuple[Action, Action]:
    return env.action_space.low.astype(np.float64), env.action_space.high.astype(np.float64)


def random(env: Any, rng: np.random.Generator) -> Driver:
    """Uniform random actions."""
    low, high = _box(env)
    return lambda: rng.uniform(low, high)


def corners(hold: int) -> Maker:
    """A random corner of the action space, held for so many steps."""

    def make(env: Any, rng: np.random.Generator) -> Driver:
        low, high = _box(env)
        return held(lambda: (hold, np.where(rng.random(low.size) < 0.5, low, high)))

    return make


bang_bang = corners(hold=1)
pulse = corners(hold=15)


def clamp_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """At full speed along the last axis, now and then a little back, and anything along the others."""
    low, high = _box(env)

    def draw() -> tuple[int, Action]:
        action = rng.uniform(low, high)
        action[-1] = high[-1] if rng.random() < 0.8 else 0.2 * low[-1]
        return int(rng.integers(50, 500)), action

    return held(draw)


def end_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Everything towards one end, long enough to get there, then towards the other."""
    low, high = _box(env)
    ends = cycle((high, low))
    return held(lambda: (int(rng.integers(20, 80)), next(ends)))


@stepwise
def carrying(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Balances the pole (LQR about upright, on the env's own model) and carries it to one end, then to the other."""
    low, high = _box(env)
    gain, ways = balancing_gain(env), cycle((-1.0, 1.0))
    way = held(lambda: (int(rng.integers(100, 300)), next(ways)))
    while True:
        away = np.concatenate([env.data.qpos, env.data.qvel])
        away[0] = -0.3 * way()  # the carrot: always a little farther on
        yield np.asarray(np.clip(-gain @ away, low, high))


def balancing_gain(env: Any) -> np.ndarray:
    """Of u = -gain @ (qpos, qvel), shape (nu, 2 nv), from differences of one held control step at rest."""
    model: mujoco.MjModel = env.model
    data, n, nudge = mujoco.MjData(model), model.nv, 1e-5

    def after(x: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = x[:n], x[n : 2 * n], x[2 * n :]
        mujoco.mj_step(model, data, env.frame_skip)
        return np.concatenate([data.qpos, data.qvel])

    steps = nudge * np.eye(2 * n + model.nu)
    slopes = np.array([(after(step) - after(-step)) / (2.0 * nudge) for step in steps]).T
    a, b = slopes[:, : 2 * n], slopes[:, 2 * n :]
    cost = np.eye(model.nu)
    value = solve_discrete_are(a, b, np.eye(2 * n), cost)
    return np.asarray(np.linalg.solve(cost + b.T @ value @ b, b.T @ value @ a))


@stepwise
def speed_seeking(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Every motor pushes its joint the way that it moves already; now and then one is turned round."""
    low, high = _box(env)
    dofs = env.model.jnt_dofadr[env.model.actuator_trnid[:, 0]]
    while True:
        steps, motor = int(rng.integers(10, 60)), int(rng.integers(low.size))
        for left in reversed(range(steps)):
            forward = env.data.qvel[dofs] >= 0.0
            if left < 5:
                forward[motor] = not forward[motor]
            yield np.where(forward, high, low)


def point_seeking(body: str, points: list[tuple[float, ...]]) -> Maker:
    """Pulls a body to one point after another by its Jacobian's transpose, 50 steps; between two of them, anywhere.

    Args:
        body: Its name; the origin is meant.
        points: In the world, (x, y, z), m.
    """

    @stepwise
    def pull(env: Any, rng: np.random.Generator) -> Iterator[Action]:
        model: mujoco.MjModel = env.model
        data, index = mujoco.MjData(model), model.body(body).id
        dofs, gear = model.jnt_dofadr[model.actuator_trnid[:, 0]], model.actuator_gear[:, 0]
        low, high = _box(env)
        jacobian = np.zeros((3, model.nv))
        while True:
            thrown, point = rng.uniform(low, high), np.array(points[rng.integers(len(points))])
            yield from [thrown] * 25
            for _ in range(50):
                data.qpos[:] = env.data.qpos
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_jacBody(model, data, jacobian, None, index)
                force = jacobian[:, dofs].T @ (point - data.xpos[index]) * gear
                # As strong as the actuators can along that direction.
                yield np.asarray(np.clip(force / max(float(np.abs(force / high).max()), 1e-12), low, high))

    return pull


@stepwise
def wall_seeking(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """A point on two axes: at full force to a random spot on one of the nearest walls, then to another."""
    geoms = wall_geoms(env.model)
    middle, half = env.model.geom_pos[geoms, :2], env.model.geom_size[geoms, :2]

    def draw() -> tuple[int, Action]:
        away = np.linalg.norm(np.maximum(np.abs(env.data.qpos[:2] - middle) - half, 0.0), axis=1)
        pick = np.argsort(away)[rng.integers(6)]
        return int(rng.integers(5, 60)), middle[pick] + rng.uniform(-half[pick], half[pick])

    return _running_to(env, held(draw))


@stepwise
def corner_seeking(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Past (or at) the corners of walls, from one side to the other, at full force: where the path bends."""
    geoms = wall_geoms(env.model)
    middle, half = env.model.geom_pos[geoms, :2], env.model.geom_size[geoms, :2]
    sides = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])
    corners = (middle[:, None] + sides * half[:, None]).reshape(-1, 2)

    def draw() -> tuple[int, Action]:
        place = env.data.qpos[:2]
        near = np.argsort(np.linalg.norm(corners - place, axis=1))[:6]
        way = corners[rng.choice(near)] - place
        across = np.array([-way[1], way[0]]) / max(float(np.linalg.norm(way)), 1e-9)
        aside = rng.normal(0.0, 0.12) * across
        return int(rng.integers(5, 60)), place + rng.uniform(1.0, 3.0) * way + aside

    return _running_to(env, held(draw))


def _running_to(env: Any, spot: Callable[[], Action]) -> Iterator[Action]:
    """At full force to a place in the plane, m."""
    while True:
        offset = spot() - env.data.qpos[:2]
        yield np.asarray(offset / max(float(np.abs(offset).max()), 1e-9))


def planning(gain: Callable[[Any, np.ndarray], float]) -> Maker:
    """Rolls random changes of its plan out on the env's model, and goes on with the best (predictive sampling).

    Args:
        gain: How good a path of the env's root is, shape (steps + 1, 2), m; larger is better.
    """
    steps, tries, keep = 12, 8, 2

    @stepwise
    def run(env: Any, rng: np.random.Generator) -> Iterator[Action]:
        model: mujoco.MjModel = env.model
        data, substeps = mujoco.MjData(model), stepped(env).frame_skip
        low, high = _box(env)
        snapshot = np.zeros(mujoco.mj_stateSize(model, _STATE))
        best = np.zeros((steps, low.size))

        def worth(plan: np.ndarray) -> float:
            mujoco.mj_setState(model, data, snapshot, _STATE)
            path = [data.qpos[:2].copy()]
            for control in plan:
                data.ctrl[:] = control
                mujoco.mj_step(model, data, substeps)
                path.append(data.qpos[:2].copy())
            return gain(env, np.array(path))

        while True:
            mujoco.mj_getState(model, env.data, snapshot, _STATE)
            plans = [best]
            for _ in range(tries):
                size = rng.choice([0.2, 0.5, 1.0]) * (high - low) / 2.0
                change = np.repeat(rng.normal(size=(steps // 2, low.size)), 2, axis=0) * size
                plans.append(np.clip(best + change, low, high))
            best = max(plans, key=worth)
            for _ in range(keep):
                yield best[0]
                best = np.concatenate([best[1:], best[-1:]])

    return run


def _fastest(plane: bool) -> Callable[[Any, np.ndarray], float]:
    def value(env: Any, path: np.ndarray) -> float:
        moved = np.diff(path, axis=0)
        speeds = np.linalg.norm(moved, axis=1) if plane else moved[:, 0]
        # Sooner or later the fastest step counts, but a robot that runs gets there more often.
        return float(speeds.max() + 2.0 * speeds.mean())

    return value


def _closest(env: Any, path: np.ndarray) -> float:
    geoms = wall_geoms(env.model)
    beyond = np.abs(path[-1] - env.model.geom_pos[geoms, :2]) - env.model.geom_size[geoms, :2]
    return -float(np.linalg.norm(np.maximum(beyond, 0.0), axis=1).min())


sprinting_along_x = planning(_fastest(plane=False))
sprinting = planning(_fastest(plane=True))
running_into_walls = planning(_closest)
