"""Drivers that make life hard for a filter on a Fetch arm; each is a function of the unwrapped env, seeded."""

from typing import Any

import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks import mujoco_drivers
from benchmarks.drivers import Action, Driver
from benchmarks.fetch_judge import ball_of, box_of
from benchmarks.mujoco_drivers import Maker
from safe_wrappers.recipes import RECIPES

DISPLACEMENT_M = 0.05


def seeking(points: Any, hold: int) -> Maker:
    """At full speed to one point after another, and on: each axis as far as it goes until it is there.

    Args:
        points: Of the env and a generator: the next point, m.
        hold: Steps for each, at most; half of it at least.
    """

    def make(env: Any, rng: np.random.Generator) -> Driver:
        model: mujoco.MjModel = env.model
        data, site = mujoco.MjData(model), model.site("robot0:grip").id
        state: dict[str, Any] = {"left": 0, "point": np.zeros(3), "fingers": 1.0}

        def act() -> Action:
            if state["left"] == 0:
                state.update(
                    left=int(rng.integers(hold // 2, hold + 1)),
                    point=np.asarray(points(env, rng)),
                    fingers=float(rng.choice([-1.0, 1.0])),
                )
            state["left"] -= 1
            data.qpos[:] = env.data.qpos
            mujoco.mj_kinematics(model, data)
            wanted = (state["point"] - data.site_xpos[site]) / DISPLACEMENT_M
            return np.append(np.clip(wanted, -1.0, 1.0), state["fingers"])

        return act

    return make


def _beyond_a_corner(env: Any, rng: np.random.Generator) -> Action:
    """0.15 m beyond a corner of the gripper's box."""
    low, high = box_of(env)
    return np.where(rng.random(3) < 0.5, low - 0.15, high + 0.15)


def _beyond_a_side(env: Any, rng: np.random.Generator) -> Action:
    """Somewhere on a side of the box, and 0.15 m out: full speed straight on, slowly along."""
    low, high = box_of(env)
    point, axis = rng.uniform(low, high), int(rng.integers(3))
    point[axis] = low[axis] - 0.15 if rng.random() < 0.5 else high[axis] + 0.15
    return np.asarray(point)


def _in_the_table(env: Any, rng: np.random.Generator) -> Action:
    """Deep in the table, at its edges too; now and then high above it, to come down again."""
    low, high = box_of(env)
    point = rng.uniform(low - 0.05, high + 0.05)
    point[2] = low[2] - 0.2 if rng.random() < 0.8 else low[2] + 0.15
    return np.asarray(point)


def _in_the_ball(env: Any, rng: np.random.Generator) -> Action:
    """Near the ball's centre; now and then away, to come back from elsewhere."""
    low, high = box_of(env)
    centre, _ = ball_of(env)
    return np.asarray(centre + rng.uniform(-0.03, 0.03, 3) if rng.random() < 0.7 else rng.uniform(low, high))


def margin_reading(ball: bool) -> Maker:
    """Knows the filter: of random actions, the one that it would still admit, and hardly.

    So it rides along the edges of what is admitted, as fast as that goes, to where the next step is left least.

    Args:
        ball: Whether the filter keeps the fingers out of the ball, too.
    """

    def make(env: Any, rng: np.random.Generator) -> Driver:
        recipe = RECIPES[env.spec.id.rpartition("-v")[0]]
        constraints: list[Any] = recipe(env, keep_out=obstacles(env) if ball else [])
        plant = sw.plants.DisplacementPlant()
        plant.bind(env)
        bound = [constraint.bind(plant) for constraint in constraints]
        state: dict[str, Any] = {"way": rng.normal(size=3)}

        def left(action: Action) -> float:
            return float(min(c.slacks(action).min() for c in bound))

        def act() -> Action:
            plant.observe()
            for c in bound:
                c.observe(c.start())  # nobody says when an episode begins
            if rng.random() < 0.04:
                state["way"] = rng.normal(size=3)
            fingers = rng.choice([-1.0, 1.0])
            noisy = 3.0 * (state["way"] + 0.7 * rng.normal(size=3))
            tries = [np.append(np.clip(noisy, -1.0, 1.0), fingers)]
            tries += [np.where(rng.random(4) < 0.5, -1.0, 1.0) for _ in range(2)]
            found = [(left(action), k) for k, action in enumerate(tries)]
            admitted = [pair for pair in found if pair[0] >= 0.0]
            return tries[min(admitted)[1] if admitted else max(found)[1]]

        return act

    return make


def obstacles(env: Any) -> list[sw.constraints.Sphere]:
    """The ball, as the filter is told of it."""
    centre, radius = ball_of(env)
    return [sw.constraints.Sphere(centre.tolist(), radius)]


def drivers(ball: bool) -> dict[str, Maker]:
    """By name."""
    known: dict[str, Maker] = {
        "random": mujoco_drivers.random,
        "bang-bang": mujoco_drivers.bang_bang,
        "pulse": mujoco_drivers.pulse,
        "corner-seeking": seeking(_beyond_a_corner, 30),
        "side-seeking": seeking(_beyond_a_side, 20),
        "table-seeking": seeking(_in_the_table, 12),
        "margin-reading": margin_reading(ball),
    }
    return known | ({"ball-seeking": seeking(_in_the_ball, 12)} if ball else {})
