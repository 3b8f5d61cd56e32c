"""Envs of other packages under drivers that look for violations, without the filter and with `protect`.

    python -m benchmarks shelf    # three hours on two cores; goes on where it was stopped
    python -m benchmarks shelf --only Pendulum-v1

Violations are judged on the env after every step, by functions of this file. Needs gymnasium's extra "box2d",
gymnasium-robotics, panda-gym, highway-env and shimmy with dm_control for their rows, which are left out where they
are not installed. The drivers: "random"; "greedy", of eight random actions (of all discrete ones) that which earns
most when it is held for five steps in a simulation; "attacking", that which comes nearest to a violation.
"""

import importlib
import importlib.util
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.tables import RUNS, keep, markdown, measured, options
from safe_wrappers.plants import View
from safe_wrappers.wrappers.recipes import PLANTS

DRIVERS = ("random", "greedy", "attacking")
_TRIED, _HELD = 8, 5


class Case(NamedTuple):
    """An env, how far it is from a violation, how many steps are made, and what it needs."""

    env_id: str
    h: Callable[[View], float]
    steps: int = 20_000
    needs: str = ""


def _fallen(view: View, limit: float, angle: float) -> float:
    return -1.0 if view.env.game_over else limit - abs(angle)


def _panda(view: View) -> float:
    at = np.asarray(view.env.robot.get_ee_position())
    return float(min(*(at - (-0.2, -0.2, 0.02)), *((0.2, 0.2, 0.3) - at)))


def _physics(view: View) -> Any:
    return view.env._env.physics


CASES = (
    Case("Pendulum-v1", lambda view: 6.0 - abs(view.env.state[1])),
    Case("MountainCarContinuous-v0", lambda view: 0.045 - abs(view.env.state[1])),
    Case(
        "CartPole-v1", lambda view: min(0.15 - abs(view.env.state[2]), (2.0 - abs(view.env.state[0])) / 13.0)
    ),
    Case(
        "LunarLanderContinuous-v3",
        lambda view: min(_fallen(view, 0.6, view.env.lander.angle), 1.0 - abs(view.observation[0])),
        1_500,
        "Box2D",
    ),
    Case("BipedalWalker-v3", lambda view: _fallen(view, 0.8, view.env.hull.angle), 1_500, "Box2D"),
    Case("PandaReach-v3", _panda, 1_500, "panda_gym"),
    Case("highway-fast-v0", lambda view: -float(view.env.vehicle.crashed), 400, "highway_env"),
    Case(
        "FrankaKitchen-v1",
        lambda view: 1.0 - float(np.abs(view.env.robot_env.data.qvel[:7]).max()),
        400,
        "gymnasium_robotics",
    ),
    Case(
        "dm_control/cartpole-swingup-v0",
        lambda view: 1.0 - abs(float(_physics(view).data.qpos[0])),
        2_000,
        "shimmy",
    ),
    Case(
        "dm_control/walker-run-v0",
        lambda view: 1.0 - float(_physics(view).named.data.sensordata["torso_subtreelinvel"][0]),
        600,
        "shimmy",
    ),
)


def driven(case: Case, driver: str, env: gym.Env[Any, Any], plant: sw.SimulatorPlant) -> Any:
    """The driver's action in the env's present state."""
    space = env.action_space
    if driver == "random":
        return space.sample()
    discrete = isinstance(space, gym.spaces.Discrete)
    tried = list(range(space.n)) if discrete else [space.sample() for _ in range(_TRIED)]  # type: ignore[attr-defined]
    scores = []
    for action in tried:
        control = np.atleast_1d(np.asarray(action, dtype=float))
        rollout = plant.rollout(control, _HELD, measure=case.h)
        scores.append(sum(rollout.rewards) if driver == "greedy" else -min(rollout.values))
    return tried[int(np.argmax(scores))]


def run(case: Case, driver: str, on: bool, steps: int) -> dict[str, float]:
    """Drive the env, and judge it after every step."""
    gym.register_envs(importlib.import_module(case.needs or "gymnasium"))
    env = gym.make(case.env_id)
    plant: Any = PLANTS.get(case.env_id.rpartition("-v")[0], sw.SimulatorPlant)()
    plant.bind(env)
    stepped: gym.Env[Any, Any] = sw.protect(env) if on else env
    env.action_space.seed(0)
    found = dict.fromkeys(("violations", "unflagged", "changed", "infeasible", "return", "seconds"), 0.0)
    observation, info = stepped.reset(seed=0)
    plant.executed(None)
    for _ in range(steps):
        action = driven(case, driver, stepped, plant)
        started = time.perf_counter()
        observation, reward, terminated, truncated, info = stepped.step(action)
        found["seconds"] += time.perf_counter() - started
        plant.received(observation, info)
        violated = case.h(View(env.unwrapped, observation, info)) < 0.0
        flagged = bool(info.get("cbf/infeasible")) or bool(info.get("cbf/unsafe"))
        found["violations"] += violated
        found["unflagged"] += violated and not flagged
        found["changed"] += bool(info.get("cbf/intervened"))
        found["infeasible"] += bool(info.get("cbf/infeasible"))
        found["return"] += float(reward)
        if terminated or truncated:
            stepped.reset()
            plant.executed(None)
    stepped.close()
    return found


class Job(NamedTuple):
    """A row of the table."""

    env: str
    driver: str
    steps: int


def row(job: Job) -> dict[str, Any]:
    """Its figures, per step where they are not counts."""
    case = next(case for case in CASES if case.env_id == job.env)
    off, on = (run(case, job.driver, filtered, job.steps) for filtered in (False, True))
    found = job._asdict() | {"violations_off": off["violations"], "violations_on": on["violations"]}
    found |= {"unflagged": on["unflagged"]} | {key: on[key] / job.steps for key in ("changed", "infeasible")}
    for name, side in (("off", off), ("on", on)):
        found |= {f"{key}_{name}": side[key] / job.steps for key in ("return", "seconds")}
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """The table that the docs show."""
    lines = []
    for one in rows:
        counts = (f"{int(one[key]):,}" for key in ("steps", "violations_off", "violations_on", "unflagged"))
        shares = (f"{100 * one[key]:.2g} %" for key in ("changed", "infeasible"))
        returns = "; ".join(f"{one[key]:.3g}" for key in ("return_off", "return_on"))
        times = "; ".join(f"{1e3 * one[key]:.2g}" for key in ("seconds_off", "seconds_on"))
        lines.append([one["env"], one["driver"], *counts, *shares, returns, times])
    head = "env | driver | steps | violations off | on | of these unflagged | changed | infeasible"
    return markdown(f"{head} | reward per step off; on | step, ms off; on", lines)


def main() -> None:
    """Measure what is missing and can be, print the table."""
    given = options(__doc__, only=[])
    warnings.simplefilter("ignore")  # of unsafe states, which are counted
    jobs = []
    for case in CASES:
        if importlib.util.find_spec(case.needs or "gymnasium") is None:
            print(f"{case.env_id}: {case.needs} is not installed")
        elif case.env_id in (given.only or [case.env_id]):
            jobs += [Job(case.env_id, driver, case.steps) for driver in DRIVERS]
    keep("shelf", table(measured(RUNS / "shelf/shelf.jsonl", jobs, row, 1)), not given.only)
