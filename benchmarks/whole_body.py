"""Learned Ant and Humanoid policies without and with `WholeBodyFilter`: contacts, balance, joints, falls, time.

    safe-wrappers train configs/velocity_experts.yaml     # once: the policies (about two hours on two cores)
    python -m benchmarks.whole_body                       # the table
    python -m benchmarks.whole_body --episodes 2 --robots Humanoid

The policies were trained by PPO without a filter and act deterministically, on Ant-v5 and Humanoid-v5, the same
episode seeds for every arm. The judge is the env's own simulation: every control step is made once more with all
evaluations of the physics in sight (each of the four stages of a Runge-Kutta step), and the forces of contacts
between the robot and the fixed world are read there.

- cone left: share of control steps in which a contact force leaves the cone of `SHARE` of the model's friction, at
  all, and by more than 1 % of the robot's weight; `unflagged` are steps that leave the cone of the filter's own share
  by that much, and that the filter did not flag.
- zmp: of the evaluations at which there is a support polygon (three contact points of one plane), the share at which
  the zero moment point is within 1 cm of its edge or beyond; and how many evaluations have a polygon at all.
- joints: share of control steps with a driven joint more than 0.1 rad beyond its stop.
- falls: episodes that the env ended as unhealthy.

The second table asks, along the unfiltered policies, what the program's answer is worth where the forecast of the
whole control step refuses the policy's torques: whether the forecast admits it, and how far it is from them.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks.tables import RESULTS
from safe_wrappers.control.legged.support import common_plane, support_polygon
from safe_wrappers.plants.mujoco.model import fixed_bodies
from safe_wrappers.plants.mujoco.replay import Replay

CONFIG = Path(__file__).parents[1] / "configs" / "velocity_experts.yaml"
SHARE, TOLERANCE, INSET_M, STOP_RAD = 0.7, 0.01, 0.01, 0.1
_ROUNDING = 1e-6

ARMS: dict[str, Callable[[Any], Any]] = {
    "no filter": lambda env: env,
    "program, pyramids": lambda env: sw.WholeBodyFilter(env, contacts="pyramid"),
    "program, exact cones": lambda env: sw.WholeBodyFilter(env, contacts="cone"),
    "forecast, contacts alone": lambda env: sw.WholeBodyFilter(env, joint_tolerance=None),
    "forecast": lambda env: sw.WholeBodyFilter(env),
    "forecast, zmp inset 1 cm": lambda env: sw.WholeBodyFilter(env, zmp_inset=INSET_M),
    "forecast, share 0.9": lambda env: sw.WholeBodyFilter(env, friction_share=0.9),
}
OWN_SHARE = {"forecast, share 0.9": 0.9}
"""Of the arms that count on more friction than `SHARE`."""


@dataclass
class Row:
    """One arm of one robot, summed over its steps."""

    robot: str
    arm: str
    episodes: int = 0
    steps: int = 0
    falls: int = 0
    reward: float = 0.0
    forward_m: float = 0.0
    seconds: float = 0.0
    left_cone: int = 0
    left_cone_by_tolerance: int = 0
    unflagged: int = 0
    evaluations: int = 0
    polygons: int = 0
    near_edge: int = 0
    beyond_stop: int = 0
    changed: int = 0
    infeasible: int = 0
    correction: float = 0.0
    decision_ms: list[float] = field(default_factory=list)


class Judge:
    """What the contacts of a step were, on the env's own model, with no code of a constraint in it.

    Args:
        raw: The env.
        share: That the filter counts on.
    """

    def __init__(self, raw: Any, share: float = SHARE) -> None:
        self._raw, self._share, self._replay = raw, share, Replay(raw)
        m = raw.model
        self._fixed = fixed_bodies(m)
        self._weight = float(m.body_mass.sum() * np.linalg.norm(m.opt.gravity))
        joints = m.actuator_trnid[:, 0]
        self._qpos, self._range = m.jnt_qposadr[joints], m.jnt_range[joints]

    def before(self) -> None:
        """Keep the state that the step starts from."""
        self._replay.before()

    def after(self, row: Row, flagged: bool) -> None:
        """Make the step once more and count."""
        held = [(0.0, 0.0)]

        def visit(data: mujoco.MjData, _: float) -> None:
            points, normals, forces = self._contacts(data, held)
            row.evaluations += 1
            if len(points) < 3:
                return
            ground = common_plane(np.array(points), np.array(normals))
            polygon = None if ground is None else support_polygon(ground.flat(points))
            if ground is None or polygon is None or len(polygon) < 3:
                return
            total = np.sum(forces, axis=0)
            pressure = total @ ground.normal
            if pressure <= 0.0:
                return  # they touch, and nothing presses
            moment = np.cross(np.array(points) - ground.origin, forces).sum(axis=0)
            zmp = ground.origin + np.cross(ground.normal, moment) / pressure
            edges = np.roll(polygon, -1, axis=0) - polygon  # anticlockwise
            inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
            inward /= np.linalg.norm(edges, axis=1, keepdims=True)
            row.polygons += 1
            row.near_edge += not ((ground.flat(zmp) - polygon) * inward).sum(axis=1).min() >= INSET_M

        if not self._replay.after(visit):
            raise RuntimeError(
                "the replay of a step does not end where the env did: its contacts are not known"
            )
        sideways, most = np.array(held).T
        excess, own = (float((sideways - share * most).max()) for share in (SHARE, self._share))
        tolerated = (TOLERANCE + _ROUNDING) * self._weight
        row.left_cone += excess > _ROUNDING * self._weight
        row.left_cone_by_tolerance += excess > tolerated
        row.unflagged += own > tolerated and not flagged
        at = self._raw.data.qpos[self._qpos]
        past = np.maximum(self._range[:, 0] - at, at - self._range[:, 1])
        row.beyond_stop += bool((past > STOP_RAD + _ROUNDING).any())

    def _contacts(
        self, data: mujoco.MjData, held: list[tuple[float, float]]
    ) -> tuple[list[Any], list[Any], list[Any]]:
        points, normals, forces = [], [], []
        m, wrench = self._raw.model, np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            first, second = (bool(self._fixed[m.geom_bodyid[g]]) for g in (contact.geom1, contact.geom2))
            if first == second or contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(m, data, i, wrench)
            # What it holds sideways, and the most that all of its friction could.
            held.append((float(np.hypot(wrench[1], wrench[2])), float(contact.friction[0] * wrench[0])))
            sign = 1.0 if first else -1.0
            frame = contact.frame.reshape(3, 3)
            points.append(contact.pos.copy())
            normals.append(sign * frame[0])
            forces.append(sign * (wrench[:3] @ frame))
        return points, normals, forces


def learned(robot: str) -> Callable[[Any], Any]:
    """The trained policy of a robot; says how to train it where there is none."""
    from safe_wrappers.train.config import parse_experiment, read_config
    from safe_wrappers.train.run.policy import TrainedPolicy
    from safe_wrappers.train.run.training import finished_checkpoint

    experiment = parse_experiment(read_config(CONFIG))
    arm = next(a for a in experiment.arms if a.name == robot)
    return TrainedPolicy(arm, finished_checkpoint(arm, 0, experiment.run_folder(arm, 0)))


def drive(robot: str, arm: str, policy: Callable[[Any], Any], episodes: int, limit: int) -> Row:
    """One arm of the table."""
    row = Row(robot, arm)
    bare = gym.make(f"{robot}-v5", max_episode_steps=limit)
    env, judge = ARMS[arm](bare), Judge(bare.unwrapped, OWN_SHARE.get(arm, SHARE))
    filtered = isinstance(env, sw.CBFActionFilter)
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        start, done = float(bare.unwrapped.data.qpos[0]), False
        while not done:
            judge.before()
            began = env.filter_seconds if filtered else 0.0
            observation, reward, fell, out_of_time, info = env.step(policy(observation))
            done = fell or out_of_time
            row.steps += 1
            row.reward += float(reward)
            row.falls += fell
            flagged = filtered and (info["cbf/infeasible"] or info["cbf/fallback"])
            judge.after(row, bool(flagged))
            if filtered:
                row.changed += bool(info["cbf/intervened"])
                row.infeasible += bool(info["cbf/infeasible"])
                row.correction += float(info["cbf/correction"])
                row.decision_ms.append(1e3 * (env.filter_seconds - began))
        row.forward_m += float(bare.unwrapped.data.qpos[0]) - start
        row.episodes += 1
    row.seconds = row.steps * float(bare.unwrapped.dt)
    env.close()
    return row


@dataclass
class Answers:
    """What the programs say where the forecast refuses the policy."""

    robot: str
    refused: int = 0
    admitted: dict[str, int] = field(default_factory=dict)
    corrections: dict[str, list[float]] = field(default_factory=dict)


def ask_programs(robot: str, policy: Callable[[Any], Any], episodes: int, limit: int) -> Answers:
    """The programs' answers, judged by the forecast."""
    answers = Answers(robot)
    env = gym.make(f"{robot}-v5", max_episode_steps=limit)
    plant = sw.MujocoPlant()
    plant.bind(env)
    forecast = sw.constraints.ContactFeasibility(SHARE, TOLERANCE).bind(plant)
    programs = {
        "pyramids": sw.constraints.Stance(SHARE, joint_tolerance=None).bind(plant),
        "exact cones": sw.constraints.Stance(SHARE, cone="exact", joint_tolerance=None).bind(plant),
    }
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        done = False
        while not done:
            action = policy(observation)
            proposed = np.asarray(action, dtype=np.float64)
            plant.observe()
            for constraint in (forecast, *programs.values()):
                constraint.observe(constraint.start())
            if not forecast.admits(proposed):
                answers.refused += 1
                for name, program in programs.items():
                    program.admits(proposed)
                    (answer,) = program.candidates(proposed)
                    if forecast.admits(answer):
                        answers.admitted[name] = answers.admitted.get(name, 0) + 1
                    distance = float(np.linalg.norm(answer - proposed))
                    answers.corrections.setdefault(name, []).append(distance)
            observation, _, fell, out_of_time, _ = env.step(action)
            done = fell or out_of_time
    env.close()
    return answers


ANSWERS_HEADER = (
    "| robot | program | steps that the forecast refuses | answer admitted by the forecast | mean correction |\n"
    + "|---" * 5
    + "|"
)


def answer_lines(answers: Answers) -> list[str]:
    """Rows of the second table."""
    return [
        f"| {answers.robot} | {name} | {answers.refused} | {answers.admitted.get(name, 0) / answers.refused:.0%} "
        f"| {np.mean(distances):.2f} |"
        for name, distances in answers.corrections.items()
    ]


HEADER = (
    "| robot | arm | falls | steps per episode | reward per step | m/s forward | cone left "
    "| by more than 1 % of weight | unflagged | with a polygon | zmp near its edge | joint beyond | changed "
    "| infeasible | correction | ms per decision: median, 99 % |\n" + "|---" * 16 + "|"
)


def line(row: Row) -> str:
    """A row of the Markdown table."""
    n = row.steps
    near = f"{row.near_edge / row.polygons:.0%}" if row.polygons else "-"
    times = row.decision_ms
    spent = f"{np.median(times):.1f}, {np.quantile(times, 0.99):.1f}" if times else "-"
    cells = (
        row.robot,
        row.arm,
        f"{row.falls} of {row.episodes}",
        f"{n / row.episodes:.0f}",
        f"{row.reward / n:.2f}",
        f"{row.forward_m / row.seconds:.2f}",
        f"{row.left_cone / n:.1%}",
        f"{row.left_cone_by_tolerance / n:.1%}",
        f"{row.unflagged}" if times else "-",
        f"{row.polygons / row.evaluations:.1%}",
        near,
        f"{row.beyond_stop / n:.1%}",
        f"{row.changed / n:.0%}" if times else "-",
        f"{row.infeasible / n:.1%}" if times else "-",
        f"{row.correction / n:.2f}" if times else "-",
        spent,
    )
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=["Ant", "Humanoid"], choices=["Ant", "Humanoid"])
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--limit", type=int, default=500, help="steps per episode at most")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    policies = {robot: learned(robot) for robot in arguments.robots}
    print(ANSWERS_HEADER)
    second = [ANSWERS_HEADER]
    for robot, policy in policies.items():
        second += answer_lines(ask_programs(robot, policy, arguments.episodes, arguments.limit))
    print("\n".join(second[1:]))
    print(HEADER)
    rows: list[Row] = []
    for robot, policy in policies.items():
        for arm in arguments.arms:
            rows.append(drive(robot, arm, policy, arguments.episodes, arguments.limit))
            print(line(rows[-1]), flush=True)
    arguments.results.mkdir(parents=True, exist_ok=True)
    table = "\n".join([HEADER, *map(line, rows)])
    text = (
        f"{arguments.episodes} episodes of at most {arguments.limit} steps\n\n{table}\n\n"
        + "\n".join(second)
        + "\n"
    )
    (arguments.results / "whole_body.md").write_text(text)
    with (arguments.results / "whole_body.jsonl").open("w") as out:
        for row in rows:
            data = asdict(row)
            times = data.pop("decision_ms")
            data["decision_ms"] = (
                [float(np.median(times)), float(np.quantile(times, 0.99))] if times else None
            )
            out.write(json.dumps(data) + "\n")


if __name__ == "__main__":
    main()
