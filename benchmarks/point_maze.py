"""PointMaze under adversarial and honest drivers, with the filter off and on: walls touched, and what it costs.

    python -m benchmarks.point_maze    # 100,000 steps per maze, driver and filter

A violation is a step (one physics substep here) after which MuJoCo reports a contact of the ball with a wall; it does
so from 4 mm on, both geoms' contact margins. "Lowest gap" is the distance of the ball's surface from the nearest
wall, from positions alone, negative inside. The filter is `protect` (the path is known) or, for the price of not
knowing the env's clip of the speed, `WallClearance()`.
"""

import argparse
import json
import math
import multiprocessing
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import mujoco
import numpy as np
from numpy.typing import NDArray

import safe_wrappers as sw
from safe_wrappers.errors import UnsafeStateWarning

RESULTS = Path(__file__).parent / "results"
Array = NDArray[np.float64]
Driver = Callable[[], Array]
Cell = tuple[int, int]

FORCE_STEP = 0.238
"""m/s that one step of full force adds."""
BRAKING = 22.0
"""m/s^2 that the honest drivers count on; the ball has 23.8."""
BALL = 0.1


class Maze:
    """What the drivers and the judge see of an env: the ball, the walls, the way."""

    def __init__(self, env: Any) -> None:
        self.env, self.model = env, env.model
        blocks = [g for g in range(self.model.ngeom) if self.model.geom(g).name.startswith("block")]
        self._blocks = set(blocks)
        self.middle, self.half = self.model.geom_pos[blocks, :2], self.model.geom_size[blocks, :2]
        self._scratch = mujoco.MjData(self.model)
        self._known: dict[tuple[Cell, Cell], list[Cell]] = {}

    @property
    def place(self) -> Array:
        """Of the ball's centre, m."""
        return np.array(self.env.data.qpos)

    @property
    def velocity(self) -> Array:
        """As the next step starts with it, m/s."""
        return np.asarray(np.clip(self.env.data.qvel, -5.0, 5.0))

    def gap(self, points: Array) -> float:
        """The least distance of a ball at any of the points (k, 2) from a wall, m."""
        beyond = np.abs(points[:, None] - self.middle) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=2)
        return float((outside + np.minimum(beyond.max(axis=2), 0.0)).min()) - BALL

    def touches(self) -> bool:
        """Whether MuJoCo reports a contact with a wall at the present position (its own list is a step old)."""
        self._scratch.qpos[:] = self.env.data.qpos
        mujoco.mj_fwdPosition(self.model, self._scratch)
        return any({c.geom1, c.geom2} & self._blocks for c in self._scratch.contact)

    def way(self) -> list[Array]:
        """The shortest way through the cells, the goal itself last, m."""
        maze, goal = self.env.maze, np.array(self.env.goal)
        start, end = (_cell(maze.cell_xy_to_rowcol(p)) for p in (self.place, goal))
        return [*(maze.cell_rowcol_to_xy(np.array(c)) for c in self._cells(start, end)), goal]

    def _cells(self, start: Cell, goal: Cell) -> list[Cell]:
        """Between two cells, both left out."""
        if (start, goal) in self._known:
            return self._known[start, goal]
        after: dict[Cell, Cell] = {goal: goal}
        queue = deque([goal])
        while queue and start not in after:
            here = queue.popleft()
            for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                cell = here[0] + down, here[1] + right
                if self.env.maze.maze_map[cell[0]][cell[1]] != 1 and cell not in after:
                    after[cell] = here
                    queue.append(cell)
        cells = [start]
        while cells[-1] != goal:
            cells.append(after[cells[-1]])
        self._known[start, goal] = cells[1:-1]
        return cells[1:-1]


def _cell(index: Array) -> Cell:
    return int(index[0]), int(index[1])


def fast_to(maze: Maze, target: Array) -> Array:
    """As fast as it can to rest at a point, in a straight line, at full force where that takes it."""
    offset = target - maze.place
    distance = float(np.linalg.norm(offset))
    speed = min(5.0, math.sqrt(2.0 * BRAKING * distance))
    wanted = offset / max(float(np.abs(offset).max()), 1e-9) * speed if distance > 0.05 else 8.0 * offset
    return np.asarray(np.clip((wanted - maze.velocity) / FORCE_STEP, -1.0, 1.0))


def uniform(maze: Maze, rng: np.random.Generator) -> Driver:
    """Uniform random actions."""
    return lambda: rng.uniform(-1.0, 1.0, 2)


def bang_bang(maze: Maze, rng: np.random.Generator) -> Driver:
    """Full force one way or the other along each axis, held for random times."""
    state = {"left": 0, "action": np.ones(2)}

    def act() -> Array:
        if state["left"] == 0:
            state.update(left=int(rng.geometric(0.04)), action=rng.choice([-1.0, 1.0], 2))
        state["left"] -= 1
        return np.asarray(state["action"])

    return act


def wall_seeking(maze: Maze, rng: np.random.Generator) -> Driver:
    """At full force to a random spot of one of the nearest walls, then to another."""
    state = {"left": 0, "spot": np.zeros(2)}

    def act() -> Array:
        if state["left"] == 0:
            near = np.argsort(np.linalg.norm(maze.middle - maze.place, axis=1))[:8]
            pick = rng.choice(near)
            spot = maze.middle[pick] + rng.uniform(-maze.half[pick], maze.half[pick])
            state.update(left=int(rng.integers(10, 90)), spot=spot)
        state["left"] -= 1
        offset = state["spot"] - maze.place
        return np.asarray(offset / max(float(np.abs(offset).max()), 1e-9))

    return act


def corner_seeking(maze: Maze, rng: np.random.Generator) -> Driver:
    """Past (or at) the corners of blocks, from one side to the other, at full force: where the path bends."""
    sides = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])
    state = {"left": 0, "spot": np.zeros(2)}

    def act() -> Array:
        if state["left"] == 0:
            corners = (maze.middle[:, None] + sides * maze.half[:, None]).reshape(-1, 2)
            near = np.argsort(np.linalg.norm(corners - maze.place, axis=1))[:6]
            way = corners[rng.choice(near)] - maze.place
            across = np.array([-way[1], way[0]]) / max(float(np.linalg.norm(way)), 1e-9)
            aside = rng.normal(0.0, 0.12) * across
            state.update(left=int(rng.integers(5, 60)), spot=maze.place + rng.uniform(1.0, 3.0) * way + aside)
        state["left"] -= 1
        offset = state["spot"] - maze.place
        return np.asarray(offset / max(float(np.abs(offset).max()), 1e-9))

    return act


def goal_seeking(maze: Maze, rng: np.random.Generator) -> Driver:
    """Straight to the maze's goal, blind to walls."""
    return lambda: fast_to(maze, np.array(maze.env.goal))


def careless(maze: Maze, rng: np.random.Generator) -> Driver:
    """Knows the way and cuts its corners: aims half a cell ahead of the next one, as fast as it can."""

    def act() -> Array:
        way = maze.way()
        return fast_to(maze, way[0] if len(way) == 1 else 0.5 * (way[0] + way[1]))

    return act


def expert(maze: Maze, rng: np.random.Generator) -> Driver:
    """Knows the way: as fast as it can to the farthest point of it that it can see past the walls."""

    def seen(target: Array) -> bool:
        count = int(np.linalg.norm(target - maze.place) / 0.05) + 2
        return maze.gap(maze.place + np.linspace(0.0, 1.0, count)[:, None] * (target - maze.place)) > 0.02

    def act() -> Array:
        way = maze.way()
        return fast_to(maze, next((p for p in reversed(way) if seen(p)), way[0]))

    return act


DRIVERS: dict[str, Callable[[Maze, np.random.Generator], Driver]] = {
    "random": uniform,
    "bang-bang": bang_bang,
    "wall-seeking": wall_seeking,
    "corner-seeking": corner_seeking,
    "goal-seeking": goal_seeking,
    "careless": careless,
    "expert": expert,
}
FILTERS: dict[str, Callable[[Any], Any]] = {
    "off": lambda env: env,
    "protect": sw.protect,
    "clip not known": lambda env: sw.CBFActionFilter(env, [sw.constraints.WallClearance()]),
}


@dataclass(frozen=True)
class Job:
    """One driver in one maze for so many steps."""

    maze: str
    driver: str
    filter: str
    steps: int
    seed: int = 0


def run(job: Job) -> dict[str, Any]:
    """Drive, count, and say what it cost."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted below
    gym.register_envs(gymnasium_robotics)
    env = FILTERS[job.filter](gym.make(f"PointMaze_{job.maze}-v3", reset_target=True))
    maze = Maze(env.unwrapped)
    driver = DRIVERS[job.driver](maze, np.random.default_rng(job.seed))
    count = dict.fromkeys(("violations", "goals", "intervened", "infeasible", "fallback", "unsafe"), 0)
    lowest_gap = lowest_h = math.inf
    fastest, episode = 0.0, job.seed * 100_000
    env.reset(seed=episode)
    for _ in range(job.steps):
        _, _, terminated, truncated, info = env.step(driver().astype(np.float32))
        count["violations"] += int(maze.touches())
        count["goals"] += int(info["success"])
        lowest_gap = min(lowest_gap, maze.gap(maze.place[None]))
        fastest = max(fastest, float(np.abs(maze.env.data.qvel).max()))
        if job.filter != "off":
            for name in ("intervened", "infeasible", "fallback", "unsafe"):
                count[name] += int(info[f"cbf/{name}"])
            lowest_h = min(lowest_h, info["cbf/margin"])
        if terminated or truncated:
            episode += 1
            env.reset(seed=episode)
    row: dict[str, Any] = asdict(job) | count
    row |= {"lowest_gap_m": lowest_gap, "fastest_m_s": fastest}
    return row | {"lowest_h_m": None if job.filter == "off" else lowest_h}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per maze, driver and filter."""
    lines = [
        "| maze | driver | filter | steps | violations | changed | infeasible | fallback | unsafe "
        "| lowest h (mm) | lowest gap (mm) | goals / 1000 steps |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        on = r["filter"] != "off"
        changed = f"{r['intervened'] / r['steps']:.1%}" if on else "-"
        counts = " | ".join(str(r[k]) if on else "-" for k in ("infeasible", "fallback", "unsafe"))
        h = f"{1e3 * r['lowest_h_m']:.3f}" if on else "-"
        lines.append(
            f"| {r['maze']} | {r['driver']} | {r['filter']} | {r['steps']:,} | {r['violations']:,} | {changed} "
            f"| {counts} | {h} | {1e3 * r['lowest_gap_m']:.1f} | {1e3 * r['goals'] / r['steps']:.1f} |"
        )
    sums = {
        name: sum(r["violations"] for r in rows if (r["filter"] == "off") == name) for name in (True, False)
    }
    steps = sum(r["steps"] for r in rows if r["filter"] != "off")
    return "\n".join(
        [*lines, "", f"Filtered: {sums[False]:,} violations in {steps:,} steps; unfiltered: {sums[True]:,}."]
    )


def main() -> None:
    """Run the jobs in parallel, print the table, keep the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--maze", nargs="+", default=["UMaze", "Large"])
    parser.add_argument("--driver", nargs="+", default=list(DRIVERS), choices=list(DRIVERS))
    parser.add_argument("--filter", nargs="+", default=list(FILTERS), choices=list(FILTERS))
    parser.add_argument("--steps", type=int, default=100_000, help="per maze, driver and filter")
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    arguments = parser.parse_args()
    jobs = [
        Job(maze, driver, name, arguments.steps)
        for maze in arguments.maze
        for driver in arguments.driver
        for name in arguments.filter
    ]
    RESULTS.mkdir(exist_ok=True)
    rows: list[dict[str, Any]] = []
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        for row in pool.imap(run, jobs):  # kept one by one: all of them take an hour
            rows.append(row)
            (RESULTS / "point_maze.json").write_text(json.dumps(rows, indent=1) + "\n")
            (RESULTS / "point_maze.md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
