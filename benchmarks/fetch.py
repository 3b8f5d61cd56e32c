"""Fetch arms: what they may not do, judged after every physics substep, and drivers that make life hard for a filter.

No code of a constraint is in the judge. It makes the env take its physics substeps one by one and looks at the env's
own positions after each, and after what the env does to its fingers at the end of a step; nothing is replayed.
"""

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks import mujoco_drivers
from benchmarks.drivers import Action, Maker, stepwise
from benchmarks.judges import Judge
from safe_wrappers.filter.bound import Bound
from safe_wrappers.wrappers.recipes import RECIPES

Array = np.ndarray

REACH_M = 0.25
"""Of the gripper's box, from where an episode starts, along x and y."""
FLOOR_M, CEILING_M = 0.02, 0.5
"""Of the gripper's box, above the table's top."""
_FINGER_M = 0.15
"""No part of a finger is farther from the gripper's site."""
GRACE = 10
"""Control steps within which fingers that a reset has put into the table must have left it; later it counts."""
BALL_RADIUS_M = 0.05


def box_of(raw: Any) -> tuple[Array, Array]:
    """Corners of the box that the gripper stays in, m."""
    x, y, _ = raw.initial_gripper_xpos
    table = raw.model.body("table0")
    geom = int(table.geomadr[0])
    top = float(table.pos[2] + raw.model.geom_pos[geom][2] + raw.model.geom_size[geom][2])
    low = np.array([x - REACH_M, y - REACH_M, top + FLOOR_M])
    return low, np.array([x + REACH_M, y + REACH_M, top + CEILING_M])


def ball_of(raw: Any) -> tuple[Array, float]:
    """Centre of a ball in the way, m, and its radius: beside where the gripper starts, off the table."""
    return np.asarray(raw.initial_gripper_xpos + np.array([0.02, 0.13, 0.08])), BALL_RADIUS_M


class FetchJudge(Judge):
    """The gripper in its box, nothing of the robot in contact with the table, fingers out of a ball, if there is one.

    A contact counts from MuJoCo's contact margin on (1 mm here), where it begins to push. FetchPush and FetchSlide
    start with their fingers 3 mm in the table. From there neither contacts with the table nor the box's floor count
    until the first step that keeps both, `GRACE` steps at most.

    Args:
        raw: Unwrapped env; its `_mujoco_step` is replaced by one that does the same substep by substep.
        ball: Whether the fingers keep out of the ball of `ball_of`, too.

    Attributes:
        low: Corner of the gripper's box, m.
        high: Likewise.
    """

    def __init__(self, raw: Any, ball: bool = False) -> None:
        self._raw, self._model = raw, raw.model
        self._ball = ball_of(raw) if ball else None
        model: mujoco.MjModel = raw.model
        self._at = mujoco.MjData(model)
        self._passed: list[Array] = []
        self._site = model.site("robot0:grip").id
        self._fingers = [model.geom(f"robot0:{side}_gripper_finger_link").id for side in "lr"]
        owner = [model.body(i).name for i in model.geom_bodyid]
        self._robot = np.array([name.startswith("robot0:") for name in owner])
        self._table = np.array([name == "table0" for name in owner])
        self.low, self.high = box_of(raw)
        self._missed = np.full(3, -np.inf)
        self._left = 0
        raw._mujoco_step = self._step

    def _step(self, action: Array) -> None:
        for _ in range(self._raw.n_substeps):
            mujoco.mj_step(self._model, self._raw.data)
            self._passed.append(self._raw.data.qpos.copy())

    def _look(self, qpos: Array) -> None:
        data = self._at
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_collision(self._model, data)
        place = data.site_xpos[self._site]
        now = np.array([self._elsewhere(data, place), self.low[2] - place[2], self._touch(data)])
        self._missed = np.maximum(self._missed, now)  # what is not a number stays

    def _elsewhere(self, data: mujoco.MjData, place: Array) -> float:
        """By how much the gripper is beyond its box's sides and ceiling, or a finger in the ball, m."""
        missed = float(max((self.low - place)[:2].max(), (place - self.high).max()))
        if self._ball is None:
            return missed
        centre, radius = self._ball
        if np.abs(place - centre).max() > radius + _FINGER_M:
            return missed
        return max(missed, *(radius - self._distance(data, finger, centre) for finger in self._fingers))

    def _distance(self, data: mujoco.MjData, finger: int, point: Array) -> float:
        """From a point to a finger, an oriented box, m."""
        inside = data.geom_xmat[finger].reshape(3, 3).T @ (point - data.geom_xpos[finger])
        return float(np.linalg.norm(np.maximum(np.abs(inside) - self._model.geom_size[finger], 0.0)))

    def _touch(self, data: mujoco.MjData) -> float:
        """By how much a contact of robot and table is closer than where contacts begin, m; without one -1."""
        pairs = data.contact.geom
        touching = self._table[pairs].any(axis=1) & self._robot[pairs].any(axis=1)
        if not touching.any():
            return -1.0
        return float((data.contact.includemargin - data.contact.dist)[touching].max())

    def start(self) -> float:
        """The truth of the env's present state; a table that the reset itself touches is excused."""
        self.before()
        self._look(self._raw.data.qpos)
        self._left = GRACE if self._missed[2] > 0.0 else 0
        return float(self._missed[0] if self._left else self._missed.max())

    def before(self) -> None:
        """Forget the last step."""
        self._passed.clear()
        self._missed = np.full(3, -np.inf)

    def after(self, executed: Array, info: dict[str, Any]) -> float:
        """The worst of the step's substeps and of its end."""
        for qpos in (*self._passed, self._raw.data.qpos):
            self._look(qpos)
        if not self._left:
            return float(self._missed.max())
        self._left = self._left - 1 if self._missed.max() > 0.0 else 0
        return float(self._missed[0])


DISPLACEMENT_M = 0.05
"""Of the gripper, by a full action."""


def seeking(points: Any, hold: int) -> Maker:
    """At full speed to one point after another, and on: each axis as far as it goes until it is there.

    Args:
        points: Of the env and a generator: the next point, m.
        hold: Steps for each, at most; half of it at least.
    """

    @stepwise
    def seek(env: Any, rng: np.random.Generator) -> Iterator[Action]:
        model: mujoco.MjModel = env.model
        data, site = mujoco.MjData(model), model.site("robot0:grip").id
        while True:
            left, point = int(rng.integers(hold // 2, hold + 1)), points(env, rng)
            fingers = rng.choice([-1.0, 1.0])
            for _ in range(left):
                data.qpos[:] = env.data.qpos
                mujoco.mj_kinematics(model, data)
                wanted = (point - data.site_xpos[site]) / DISPLACEMENT_M
                yield np.append(np.clip(wanted, -1.0, 1.0), fingers)

    return seek


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


def in_the_ball(env: Any, rng: np.random.Generator) -> Action:
    """Near the ball's centre; now and then away, to come back from elsewhere."""
    low, high = box_of(env)
    centre, _ = ball_of(env)
    return np.asarray(centre + rng.uniform(-0.03, 0.03, 3) if rng.random() < 0.7 else rng.uniform(low, high))


@stepwise
def margin_reading(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Knows the filter: of random actions, the one that it would still admit, and hardly.

    So it rides along the edges of what is admitted, as fast as that goes, to where the next step is left least.
    """
    plant = sw.plants.DisplacementPlant()
    plant.bind(env)
    bound = [Bound(constraint, plant) for constraint in RECIPES[env.spec.id.rpartition("-v")[0]](env)]
    way = rng.normal(size=3)

    def left(action: Action) -> float:
        return float(min(c.slacks(action).min() for c in bound))

    while True:
        plant.observe()
        for c in bound:
            c.observe({})  # nobody says when an episode begins
        if rng.random() < 0.04:
            way = rng.normal(size=3)
        fingers = rng.choice([-1.0, 1.0])
        noisy = 3.0 * (way + 0.7 * rng.normal(size=3))
        tries = [np.append(np.clip(noisy, -1.0, 1.0), fingers)]
        tries += [np.where(rng.random(4) < 0.5, -1.0, 1.0) for _ in range(2)]
        found = [(left(action), k) for k, action in enumerate(tries)]
        admitted = [pair for pair in found if pair[0] >= 0.0]
        yield tries[min(admitted)[1] if admitted else max(found)[1]]


def obstacles(env: Any) -> list[sw.constraints.Sphere]:
    """The ball, as the filter is told of it."""
    centre, radius = ball_of(env)
    return [sw.constraints.Sphere(centre.tolist(), radius)]


DRIVERS: dict[str, Maker] = {
    "random": mujoco_drivers.random,
    "bang-bang": mujoco_drivers.bang_bang,
    "pulse": mujoco_drivers.pulse,
    "corner-seeking": seeking(_beyond_a_corner, 30),
    "side-seeking": seeking(_beyond_a_side, 20),
    "table-seeking": seeking(_in_the_table, 12),
    "margin-reading": margin_reading,
}
