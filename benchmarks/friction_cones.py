"""Friction pyramids against the exact cone, on whole-body problems recorded from Ant-v5 and Humanoid-v5.

    python -m benchmarks.friction_cones                     # 500 problems per robot and policy
    python -m benchmarks.friction_cones --problems 20       # a look

Policies: "standing" (torques near zero), "random" (uniform torques, held for a few steps) and, where a policy has
been trained (`safe-wrappers train configs/velocity_experts.yaml`), "learned". At every control step with a contact
that carries force, the problem is written down: contacts that press come to rest within 50 ms, as far as they can,
the others open, 70 % of the model's friction counts, the nominal control is the policy's.

- admitted: share of problems in which the policy's own torques pass.
- lost: problems with an answer by the exact cone, and none by the pyramid.
- farther: by how much farther from the policy's torques the pyramid's answer is than the cone's, in control units
  (1 is the full torque of an Ant's motor, 0.4 of a Humanoid's), over the problems in which either changed them.
- apart: the largest difference of a torque between the two answers, over the same problems.
- us: microseconds for one solution, checked; the solvers take turns on each problem.
"""

import argparse
import contextlib
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.drivers import held
from benchmarks.tables import RESULTS, markdown
from benchmarks.whole_body import learned
from safe_wrappers.control.legged.whole_body import (
    WholeBodySolution,
    attainable_contact_acceleration,
    solve_cone,
    solve_pyramid,
)
from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem
from safe_wrappers.errors import SafeWrappersError
from safe_wrappers.plants.queries.floating_base import equations_of_motion

SHARE, SETTLE_S = 0.7, 0.05
LONGEST = 200
"""Control steps of an episode at most."""
SOLVERS: dict[str, Callable[[WholeBodyProblem], WholeBodySolution]] = {
    "cone, clarabel": solve_cone,
    "4 edges, daqp": lambda problem: solve_pyramid(problem, 4),
    "8 edges, daqp": lambda problem: solve_pyramid(problem, 8),
    "16 edges, daqp": lambda problem: solve_pyramid(problem, 16),
    "8 edges, clarabel": lambda problem: solve_pyramid(problem, 8, "clarabel"),
}
EXACT = "cone, clarabel"
POLICIES = ("standing", "random", "learned")
ANSWERED = ("inactive", "solved")

Policy = Callable[[Any], Any]


def policy_of(name: str, robot: str, space: gym.spaces.Box, rng: np.random.Generator) -> Policy | None:
    """A policy by name; None where the learned one has not been trained."""

    def standing(_: Any) -> Any:
        return (0.05 * rng.uniform(space.low, space.high)).astype(space.dtype)

    def draw() -> tuple[int, Any]:
        action = rng.uniform(space.low, space.high).astype(space.dtype)
        return int(rng.integers(1, 6)), action

    random = held(draw)

    if name == "learned":
        with contextlib.suppress(SafeWrappersError, OSError, ImportError):
            return learned(robot)
        return None
    return {"standing": standing, "random": lambda _: random()}[name]


def record(robot: str, policy: str, count: int, seed: int = 0) -> Iterator[WholeBodyProblem]:
    """Problems of one policy, from as many episodes as it takes; none of a policy that is not there."""
    env: Any = gym.make(f"{robot}-v5", max_episode_steps=LONGEST)
    plant = sw.MujocoPlant()
    plant.bind(env)
    act = policy_of(policy, robot, env.action_space, np.random.default_rng(seed))
    if act is None:
        return
    episode = found = 0
    while found < count:
        observation, _ = env.reset(seed=1000 * seed + episode)
        episode, done = episode + 1, False
        while not done and found < count:
            action = np.asarray(act(observation), dtype=np.float64)
            plant.observe()
            problem = at(plant, action)
            if problem is not None:
                found += 1
                yield problem
            observation, _, fell, out_of_time, _ = env.step(action.astype(env.action_space.dtype))
            done = fell or out_of_time
    env.close()


def at(plant: sw.MujocoPlant, nominal: Any) -> WholeBodyProblem | None:
    """The problem at a plant's state; None if no contact carries force."""
    terms = equations_of_motion(plant.model, plant.forward(), plant.actuators)
    c = terms.contacts
    pressing = np.einsum("ki,ki->k", c.forces, c.normals) > 0.0
    if not pressing.any():
        return None
    problem = WholeBodyProblem(
        terms.inertia,
        terms.bias,
        terms.actuation,
        c.jacobians,
        c.drift,
        c.normals,
        SHARE * c.friction,
        plant.lower,
        plant.upper,
        np.clip(nominal, plant.lower, plant.upper),
        contact_acceleration=-(c.jacobians @ plant.qvel) / SETTLE_S,
        breaking=~pressing,
        first_tangents=c.first_tangents,
    )
    return replace(problem, contact_acceleration=attainable_contact_acceleration(problem))


def compare(problems: list[WholeBodyProblem], repeats: int = 3) -> dict[str, dict[str, Any]]:
    """A row for each solver."""
    spent: dict[str, list[float]] = {name: [] for name in SOLVERS}
    answers: dict[str, list[WholeBodySolution]] = {name: [] for name in SOLVERS}
    for problem in problems:
        for name, solve in SOLVERS.items():
            least = np.inf
            for _ in range(repeats):
                begun = time.perf_counter()
                answer = solve(problem)
                least = min(least, time.perf_counter() - begun)
            spent[name].append(1e6 * least)
            answers[name].append(answer)
    rows = {}
    for name in SOLVERS:
        farther, apart, lost, gained = [], [], 0, 0
        for problem, mine, exact in zip(problems, answers[name], answers[EXACT], strict=True):
            both = mine.status in ANSWERED and exact.status in ANSWERED
            if both and not mine.status == exact.status == "inactive":
                ways = [float(np.linalg.norm(x.control - problem.nominal)) for x in (mine, exact)]
                farther.append(ways[0] - ways[1])
                apart.append(float(np.abs(mine.control - exact.control).max()))
            lost += exact.status in ANSWERED and mine.status not in ANSWERED
            gained += mine.status in ANSWERED and exact.status not in ANSWERED
        status = [str(answer.status) for answer in answers[name]]
        rows[name] = {
            "problems": len(problems),
            "contacts": float(np.mean([len(p.normals) for p in problems])),
            "most_contacts": max(len(p.normals) for p in problems),
            "admitted": status.count("inactive"),
            "infeasible": status.count("infeasible"),
            "failed": status.count("failed"),
            "lost": lost,
            "gained": gained,
            "farther": quantiles(farther),
            "apart": quantiles(apart),
            "us": quantiles(spent[name]),
        }
    return rows


def quantiles(values: list[float]) -> list[float] | None:
    """Median, 99th percentile and largest; None of nothing."""
    return [float(np.quantile(values, q)) for q in (0.5, 0.99, 1.0)] if values else None


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = []
    for row in rows:
        n = row["problems"]
        farther, apart = (
            "-" if row[key] is None else f"{row[key][0]:.4f}, {row[key][1]:.3f}"
            for key in ("farther", "apart")
        )
        cells = [row["robot"], row["policy"], f"{row['contacts']:.1f}, {row['most_contacts']}", row["solver"]]
        cells += [f"{row['admitted'] / n:.1%}", f"{row['infeasible'] / n:.1%}", row["failed"]]
        cells += [f"{row['lost'] / n:.1%}", *(("-", "-") if row["solver"] == EXACT else (farther, apart))]
        lines.append([*cells, f"{row['us'][0]:.0f}, {row['us'][1]:.0f}"])
    return markdown(
        "robot | policy | contacts: mean, most | solver | admitted | infeasible | failed | lost"
        " | farther: median, 99 % | apart: median, 99 % | us: median, 99 %",
        lines,
    )


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=["Ant", "Humanoid"], choices=["Ant", "Humanoid"])
    parser.add_argument("--policies", nargs="+", default=list(POLICIES), choices=POLICIES)
    parser.add_argument("--problems", type=int, default=500, help="per robot and policy")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for robot in arguments.robots:
        for policy in arguments.policies:
            problems = list(record(robot, policy, arguments.problems))
            if not problems:
                print(f"{robot}: no policy {policy!r} here")
                continue
            for name, row in compare(problems).items():
                rows.append({"robot": robot, "policy": policy, "solver": name} | row)
    print(table(rows))
    arguments.results.mkdir(parents=True, exist_ok=True)
    text = f"{arguments.problems} problems per robot and policy\n\n{table(rows)}\n"
    (arguments.results / "friction_cones.md").write_text(text)
    (arguments.results / "friction_cones.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
