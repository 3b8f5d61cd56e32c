"""Drivers that make life hard for a filter on MuJoCo robots; each is a function of the unwrapped env, seeded.

`random`, `bang_bang` and `pulse` know nothing. The others read the true state and go for one limit.
"""

from collections.abc import Callable
from itertools import cycle
from typing import Any

import mujoco
import numpy as np
from scipy.linalg import solve_discrete_are

from benchmarks.drivers import Action, Driver, Maker, held
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


def carrying(env: Any, rng: np.random.Generator) -> Driver:
    """Balances the pole (LQR about upright, on the env's own model) and carries it to one end, then to the other."""
    low, high = _box(env)
    gain, ways = balancing_gain(env), cycle((-1.0, 1.0))
    way = held(lambda: (int(rng.integers(100, 300)), next(ways)))

    def act() -> Action:
        away = np.concatenate([env.data.qpos, env.data.qvel])
        away[0] = -0.3 * way()  # the carrot: always a little farther on
        return np.asarray(np.clip(-gain @ away, low, high))

    return act


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


def speed_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Every motor pushes its joint the way that it moves already; now and then one is turned round."""
    low, high = _box(env)
    dofs = env.model.jnt_dofadr[env.model.actuator_trnid[:, 0]]
    state: dict[str, Any] = {"left": 0, "motor": 0}

    def act() -> Action:
        if state["left"] == 0:
            state.update(left=int(rng.integers(10, 60)), motor=int(rng.integers(low.size)))
        state["left"] -= 1
        forward = env.data.qvel[dofs] >= 0.0
        if state["left"] < 5:
            forward[state["motor"]] = not forward[state["motor"]]
        return np.where(forward, high, low)

    return act


def point_seeking(body: str, points: list[tuple[float, ...]], hold: int = 50) -> Maker:
    """Pulls a body to one point after another by its Jacobian's transpose; between two of them, anywhere.

    Args:
        body: Its name; the origin is meant.
        points: In the world, (x, y, z), m.
        hold: Steps for each; the bodies are thrown about for half as long before.
    """

    def make(env: Any, rng: np.random.Generator) -> Driver:
        model: mujoco.MjModel = env.model
        data, index = mujoco.MjData(model), model.body(body).id
        dofs, gear = model.jnt_dofadr[model.actuator_trnid[:, 0]], model.actuator_gear[:, 0]
        low, high = _box(env)
        state: dict[str, Any] = {"step": 0, "point": np.zeros(3), "action": high}
        jacobian = np.zeros((3, model.nv))

        def act() -> Action:
            phase = state["step"] % (hold + hold // 2)
            state["step"] += 1
            if phase == 0:
                state["action"] = rng.uniform(low, high)
                state["point"] = np.array(points[rng.integers(len(points))])
            if phase < hold // 2:
                return np.asarray(state["action"])
            data.qpos[:] = env.data.qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacBody(model, data, jacobian, None, index)
            force = jacobian[:, dofs].T @ (state["point"] - data.xpos[index]) * gear
            # As strong as the actuators can along that direction.
            return np.asarray(np.clip(force / max(float(np.abs(force / high).max()), 1e-12), low, high))

        return act

    return make


def wall_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """A point on two axes: at full force to a random spot on one of the nearest walls, then to another."""
    geoms = wall_geoms(env.model)
    middle, half = env.model.geom_pos[geoms, :2], env.model.geom_size[geoms, :2]

    def draw() -> tuple[int, Action]:
        away = np.linalg.norm(np.maximum(np.abs(env.data.qpos[:2] - middle) - half, 0.0), axis=1)
        pick = np.argsort(away)[rng.integers(6)]
        return int(rng.integers(5, 60)), middle[pick] + rng.uniform(-half[pick], half[pick])

    return _running_to(env, held(draw))


def corner_seeking(env: Any, rng: np.random.Generator) -> Driver:
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


def _running_to(env: Any, spot: Callable[[], Action]) -> Driver:
    """At full force to a place in the plane, m."""

    def act() -> Action:
        offset = spot() - env.data.qpos[:2]
        return np.asarray(offset / max(float(np.abs(offset).max()), 1e-9))

    return act


def planning(gain: Callable[[Any], Callable[[np.ndarray], float]]) -> Maker:
    """Rolls random changes of its plan out on the env's model, and goes on with the best (predictive sampling).

    Args:
        gain: Of the env: how good a path of the root is, shape (steps + 1, 2), m; larger is better.
    """
    steps, tries, keep = 12, 8, 2

    def make(env: Any, rng: np.random.Generator) -> Driver:
        model: mujoco.MjModel = env.model
        data, substeps, value = mujoco.MjData(model), stepped(env).frame_skip, gain(env)
        low, high = _box(env)
        snapshot = np.zeros(mujoco.mj_stateSize(model, _STATE))
        state: dict[str, Any] = {"step": 0, "plan": np.zeros((steps, low.size))}

        def worth(plan: np.ndarray) -> float:
            mujoco.mj_setState(model, data, snapshot, _STATE)
            path = [data.qpos[:2].copy()]
            for control in plan:
                data.ctrl[:] = control
                mujoco.mj_step(model, data, substeps)
                path.append(data.qpos[:2].copy())
            return value(np.array(path))

        def act() -> Action:
            if state["step"] % keep == 0:
                mujoco.mj_getState(model, env.data, snapshot, _STATE)
                plans = [state["plan"]]
                for _ in range(tries):
                    size = rng.choice([0.2, 0.5, 1.0]) * (high - low) / 2.0
                    change = np.repeat(rng.normal(size=(steps // 2, low.size)), 2, axis=0) * size
                    plans.append(np.clip(state["plan"] + change, low, high))
                state["plan"] = max(plans, key=worth)
            state["step"] += 1
            action: Action = state["plan"][0]
            state["plan"] = np.concatenate([state["plan"][1:], state["plan"][-1:]])
            return action

        return act

    return make


def _fastest(plane: bool) -> Callable[[Any], Callable[[np.ndarray], float]]:
    def of(env: Any) -> Callable[[np.ndarray], float]:
        def value(path: np.ndarray) -> float:
            moved = np.diff(path, axis=0)
            speeds = np.linalg.norm(moved, axis=1) if plane else moved[:, 0]
            # Sooner or later the fastest step counts, but a robot that runs gets there more often.
            return float(speeds.max() + 2.0 * speeds.mean())

        return value

    return of


def _closest(env: Any) -> Callable[[np.ndarray], float]:
    geoms = wall_geoms(env.model)
    middle, half = env.model.geom_pos[geoms, :2], env.model.geom_size[geoms, :2]

    def value(path: np.ndarray) -> float:
        beyond = np.maximum(np.abs(path[-1] - middle) - half, 0.0)
        return -float(np.linalg.norm(beyond, axis=1).min())

    return value


sprinting_along_x = planning(_fastest(plane=False))
sprinting = planning(_fastest(plane=True))
running_into_walls = planning(_closest)
