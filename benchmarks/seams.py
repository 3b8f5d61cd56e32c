"""Seams between chunks: the same learned chunk policy, handed over in several ways, with delays of 0, 2 and 5 steps.

    python -m benchmarks.seams                     # 200 episodes per row; trains the policies first, once
    python -m benchmarks.seams --episodes 10       # quicker
    python -m benchmarks.seams --envs Reacher      # of the envs whose id has one of these words

Every row of an env is the same policy, deterministic, on the same episodes. The policies
(`benchmarks/chunk_policy.py`) give a chunk as a few knots of a spline: with each entry an action by itself PPO's
chunks are jagged inside, and their own inside shakes the arm, not the seam. They are trained with replacement and
without any bound, so what a bound costs in return is what it costs a policy that does not know of it.

Plain replacement and temporal ensembling bound nothing. The blends are measured with a bound on the command's rate
alone (`rate_limit`), with a least duration alone (`blend_time`), and with both: the shortest blend that keeps a rate
may still ring, and a policy that asks for faster changes than the rate allows loses return. Both come from the arm,
or from the action's range, as `bounds_of` says.
A trial with blends of 0.12 s had been seen when the rule for the arm's `blend_time` was written down; it gives
0.12 s. Reacher's rate limit is the second one tried: the first, 10 N m/s, lies above what any seam of the policy asks
for, so that its rows were replacement's.

The first command of an episode would be a step from no torque to the policy's, which is no seam, and on the arm it
rings for a second. So for every method the policy's commands are faded in from zero over the first `blend_time` of
an episode, and a seam is a chunk that takes over from the one before it.

What is left of the vibration is not all from seams: the chunks move the arm, too. So every chunk that replacement
executed is executed again by itself, from the same state but for the springs, which start without vibration.
"""

import argparse
import json
import math
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import safe_wrappers as sw
from benchmarks.chunk_policy import RUNS, TASKS, Policy, Task, policy
from benchmarks.flexible_joint import manifold
from benchmarks.seam_bounds import Bounds, bounds_of
from benchmarks.tables import RESULTS, markdown
from safe_wrappers.checks import Array
from safe_wrappers.control.handover.seams import BLENDS
from safe_wrappers.control.handover.smoothstep import smoothstep

DELAYS = (0, 2, 5)
"""Control steps."""
RATE, TIME, RATE_AND_TIME, FLEXIBLE = "rate", "time", "rate + time", "flexible"
"""What bounds a blend; `TIME` bounds no rate, and shows what the rate's bound costs. `FLEXIBLE` finds its bounds by
itself, from the model, where springs ring."""


@dataclass(frozen=True)
class Job:
    """One way of handing over on one env, for some episodes.

    Attributes:
        env: Its id.
        task: Its table's name.
        blend: As `ChunkHandover` takes it.
        bounds: `RATE`, `TIME`, `RATE_AND_TIME`, `FLEXIBLE`, or "-" for a baseline.
        delay: Control steps.
    """

    env: str
    task: str
    blend: str
    bounds: str
    delay: int
    episodes: int
    seed: int


def jobs(task: Task, episodes: int, seed: int) -> list[Job]:
    """The rows of an env's table."""
    ways = [("replace", "-")]
    springs = (FLEXIBLE,) if "Flex" in task.env else ()
    ways += [(blend, bounds) for bounds in (RATE, TIME, RATE_AND_TIME, *springs) for blend in BLENDS]
    return [
        Job(task.env, task.name, blend, bounds, delay, episodes, seed)
        for delay in DELAYS
        for blend, bounds in ways
    ]


class Recorder(gym.Wrapper[Any, Any, Any, Any]):
    """Between the handover and the env: what was sent, control step by control step, and what came of it.

    Attributes:
        commands: Of this episode, each of shape (m,).
        states: Positions and velocities before each of them.
        energy: J, none where the env has no vibration.
        error: m, from the fingertip to the target; not a number where there is no such thing.
    """

    def reset(self, **options: Any) -> Any:
        self.commands: list[Array] = []
        self.states: list[tuple[Array, Array]] = []
        self.energy: list[float] = []
        self.error: list[float] = []
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        data: Any = self.env.unwrapped.data  # type: ignore[attr-defined]
        self.states.append((data.qpos.copy(), data.qvel.copy()))
        result = super().step(action)
        info = result[4]
        self.commands.append(np.array(action, dtype=np.float64))
        if "vibration_energy" in info:
            self.energy.append(info["vibration_energy"])
        self.error.append(info.get("tracking_error", -info.get("reward_dist", np.nan)))
        return result


def faded_in(chunk: Array, begins: int, steps: int) -> Array:
    """The chunk with what it asks for in an episode's first control steps taken down to nothing, smoothly.

    Args:
        chunk: Shape (H, m), action units.
        begins: Control step of its first entry, counted from the first command that the policy gives in the episode.
        steps: Over how many of them.
    """
    phase = (begins + np.arange(len(chunk)) + 1.0) / (steps + 1.0)
    return np.asarray(chunk * smoothstep(np.clip(phase, 0.0, 1.0))[:, None], dtype=np.float32)


def alone(env: Any, qpos: Array, qvel: Array, commands: Array) -> float:
    """The largest vibration energy, J, of commands from a state whose springs are made to carry no vibration.

    Args:
        env: A `FlexJointReach-v0` of its own, unwrapped.
        qpos: Shape (4,): motor, spring, motor, spring.
        qvel: Shape (4,).
        commands: Shape (n, 2), N m.
    """
    arm, qpos, qvel = env.arm, qpos.copy(), qvel.copy()
    motors, springs = slice(0, None, 2), slice(1, None, 2)
    qvel[springs] = 0.0
    for _ in range(5):  # the deflection turns the link, and with it what the spring carries
        q = qpos[motors] + qpos[springs]
        net = commands[0] - arm.motor_damping * qvel[motors]
        carried = manifold(net, arm.rotor_inertia, arm.link_inertia(q), arm.link_bias(q, qvel[motors]))
        qpos[springs] = -carried / arm.stiffness
    env.set_state(qpos, qvel)
    return max(env.step(command)[4]["vibration_energy"] for command in commands)


@dataclass
class Episode:
    """What an episode's seams did.

    Attributes:
        differences: The largest first, second and third of the commands, per seam, shape (n, 3), action units.
        rates: The largest `|du/dt|` from the seam to the next one, per seam, in units of the limit.
        energies: The largest vibration energy from the seam to the next one, J; none where there is no vibration.
        alone: The same of the commands `alone`; none but for replacement.
        blend_times: s.
        cut: Blends that the next seam came before the end of.
        limited: Control steps of which the command had to be held back.
        errors: m, of all control steps.
        total: Return.
    """

    differences: Array
    rates: Array
    energies: Array
    alone: list[float]
    blend_times: Array
    cut: int
    limited: int
    errors: list[float]
    total: float


def episode(env: Any, recorder: Recorder, act: Policy, job: Job, bounds: Bounds, seed: int) -> Episode:
    """Run one."""
    fade = math.ceil(bounds.blend_time / env.control_dt)
    observation, _ = env.reset(seed=seed)
    takeovers, infos, total, limited, over = [], [], 0.0, 0, False
    while not over:
        begins = len(recorder.commands)
        chunk = faded_in(act(observation), begins - job.delay, fade)
        observation, reward, terminated, truncated, info = env.step(chunk)
        total, limited, over = total + reward, limited + info["handover/limited"], terminated or truncated
        if info["handover/latency"] >= 0:
            # A delay as long as the horizon takes over in the step after, at its start.
            takeovers.append(begins + info["handover/latency"] % env.execution_horizon)
            infos.append(info)
    commands = np.array(recorder.commands)
    step = np.abs(np.diff(commands, axis=0, prepend=commands[:1])) / env.control_dt
    rates = (step / bounds.rate_limit).max(axis=1)
    blend_times = np.array([info["handover/blend_time"] for info in infos])
    energy = np.array(recorder.energy)
    ends = [*takeovers[1:], len(commands)]
    by_itself = []
    if job.blend == "replace" and len(energy):
        again = gym.make(job.env).unwrapped
        pairs = list(zip(takeovers, ends, strict=True))[1:]
        by_itself = [alone(again, *recorder.states[start], commands[start:end]) for start, end in pairs]
    return Episode(
        np.array([info["handover/seam_jump"] for info in infos])[1:],
        np.maximum.reduceat(rates, takeovers)[1:],
        np.maximum.reduceat(energy, takeovers)[1:] if len(energy) else energy,
        by_itself,
        blend_times[1:],
        int((np.rint(blend_times / env.control_dt) > np.diff(takeovers, append=len(commands)))[1:].sum()),
        limited,
        recorder.error,
        float(total),
    )


def run(job: Job, task: Task, act: Policy) -> dict[str, Any]:
    """Run the episodes; one row."""
    warnings.filterwarnings("ignore", message="a command was held back")  # counted below
    recorder = Recorder(gym.make(job.env))
    bounds = bounds_of(recorder, task.horizon, task.range_per_second)
    given: dict[str, Any] = {
        "-": {},
        RATE: {"rate_limit": bounds.rate_limit},
        TIME: {"blend_time": bounds.blend_time},
        RATE_AND_TIME: {"rate_limit": bounds.rate_limit, "blend_time": bounds.blend_time},
        FLEXIBLE: {"flexible": "auto"},
    }[job.bounds]
    env = sw.ChunkHandover(recorder, task.chunk, task.horizon, job.delay, blend=job.blend, **given)
    seeds = range(1000 * job.seed, 1000 * job.seed + job.episodes)
    episodes = [episode(env, recorder, act, job, bounds, seed) for seed in seeds]
    rates = np.concatenate([e.rates for e in episodes])
    jumps = np.concatenate([e.differences for e in episodes])
    energies = np.concatenate([e.energies for e in episodes])
    alone_energies = [x for e in episodes for x in e.alone]
    returns = np.array([e.total for e in episodes])
    steps = sum(len(e.errors) for e in episodes)
    error = float(np.mean([x for e in episodes for x in e.errors]))
    return asdict(job) | {
        "bounds_chosen": bounds.reasons,
        "seams": len(rates),
        "difference_peak": jumps.max(axis=0).tolist(),
        "difference_mean": jumps.mean(axis=0).tolist(),
        "rate_peak": float(rates.max()),
        "within": int((rates <= 1.0).sum()),
        "limited": sum(e.limited for e in episodes) / steps,
        "blend_time_mean_s": float(np.concatenate([e.blend_times for e in episodes]).mean()),
        "cut_short": sum(e.cut for e in episodes) / len(rates),
        "energy_peak_J": float(energies.max()) if len(energies) else None,
        "energy_mean_J": float(energies.mean()) if len(energies) else None,
        "alone_peak_J": max(alone_energies) if alone_energies else None,
        "alone_mean_J": float(np.mean(alone_energies)) if alone_energies else None,
        "tracking_error_mean_m": None if math.isnan(error) else error,
        "return_mean": float(returns.mean()),
        "return_standard_error": float(returns.std(ddof=1) / math.sqrt(len(returns))),
    }


def measured(
    tasks: tuple[Task, ...], episodes: int, seed: int, runs: Path, bounds: list[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Train what is not there, then all rows, or those with some bounds."""
    torch.set_num_threads(1)
    for task in tasks:
        act = policy(task, runs)
        for job in jobs(task, episodes, seed):
            if bounds is None or job.bounds in bounds:
                yield run(job, task, act)


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: for each env one line per delay and way of handing over, and what the columns are."""
    blended = [r for r in rows if r["bounds"] in (RATE, RATE_AND_TIME)]
    within, seams = (sum(r[key] for r in blended) for key in ("within", "seams"))
    parts = [
        _part(name, sorted((r for r in rows if r["task"] == name), key=lambda r: r["delay"]))
        for name in dict.fromkeys(r["task"] for r in rows)
    ]
    return "\n\n".join(
        [
            *parts,
            f"Rate kept at {within:,} of {seams:,} seams that were blended with a bound on it.",
            "Differences: the largest first, second and third differences of neighbouring commands (action units,"
            " N m on the arm; the component with the largest) over a seam's blend and three steps more, peak and "
            "mean over the seams. Rate: the largest `|du/dt|` from a seam to the next, in units of the bound; "
            "kept: the share of seams at which it is within the bound. Held back: control steps at which a "
            "command was held back beyond the blend to keep the rate. Blend: its mean length as planned, and the "
            "share of blends that the next seam cuts short. Vibration: the largest boundary-layer energy from a "
            "seam to the next, peak and mean over the seams, and how many times lower than with replacement at "
            "the same delay. Tracking error: from the fingertip to the target, mean over all control steps. "
            "Return: mean over the episodes, with its standard error.",
        ]
    )


def _part(name: str, rows: list[dict[str, Any]]) -> str:
    cells_of = []
    for r in rows:
        base = next(x for x in rows if x["blend"] == "replace" and x["delay"] == r["delay"])
        jumps = [
            f"{p:.3f} / {m:.3f}" for p, m in zip(r["difference_peak"], r["difference_mean"], strict=True)
        ]
        energies, lower = "-", "-"
        if r["energy_peak_J"] is not None:
            peak, mean = r["energy_peak_J"], r["energy_mean_J"]
            energies = f"{1e3 * peak:.3g} / {1e3 * mean:.3g}"
            lower = f"{base['energy_peak_J'] / peak:.1f} / {base['energy_mean_J'] / mean:.1f}"
        cells = [
            str(r["delay"]),
            r["blend"],
            r["bounds"],
            f"{r['seams']:,}",
            *jumps,
            f"{r['rate_peak']:.2f}",
            f"{r['within'] / r['seams']:.1%}",
            f"{r['limited']:.1%}" if r["bounds"] in (RATE, RATE_AND_TIME, FLEXIBLE) else "-",
            "-" if r["bounds"] == "-" else f"{1e3 * r['blend_time_mean_s']:.0f}, {r['cut_short']:.0%}",
            energies,
            lower,
            "-" if r["tracking_error_mean_m"] is None else f"{1e3 * r['tracking_error_mean_m']:.1f}",
            f"{r['return_mean']:.2f} ± {r['return_standard_error']:.2f}",
        ]
        cells_of.append(cells)
    head = (
        "delay | blend | bounds | seams | first difference, peak / mean | second | third | rate, peak | kept"
        " | held back | blend (ms), cut short | vibration, peak / mean (mJ) | times lower"
        " | tracking error (mm) | return"
    )
    lines = [f"**{name}**. Bounds: {rows[0]['bounds_chosen']}.", "", markdown(head, cells_of)]
    floors = [
        f"{1e3 * r['alone_peak_J']:.3g} / {1e3 * r['alone_mean_J']:.3g} mJ at a delay of {r['delay']}"
        for r in rows
        if r["alone_peak_J"] is not None
    ]
    if floors:
        lines += [
            "",
            f"Vibration of replacement's chunks alone, each begun without any: {', '.join(floors)}.",
        ]
    return "\n".join(lines)


def main() -> None:
    """Run all rows, each kept as it comes, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=200, help="per row")
    parser.add_argument(
        "--envs",
        nargs="+",
        help="words; a task whose name has one of them is run, and its rows take their place in the tables",
    )
    parser.add_argument(
        "--bounds", nargs="+", help="only rows with these bounds; the others stay as they are"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--runs", type=Path, default=RUNS, help="folder of the trained policies")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the rows and the tables")
    arguments = parser.parse_args()
    tasks = tuple(t for t in TASKS if not arguments.envs or any(word in t.name for word in arguments.envs))
    if not tasks:
        parser.error(f"nothing to run; the envs are: {', '.join(t.env for t in TASKS)}")
    if arguments.episodes < 2:
        parser.error("--episodes is at least 2, for a standard error")
    arguments.results.mkdir(parents=True, exist_ok=True)
    names = [task.name for task in tasks]
    kept = arguments.results / "seams.json"
    some = arguments.envs or arguments.bounds
    others = json.loads(kept.read_text()) if kept.exists() and some else []
    again = [
        row["task"] in names and row["bounds"] in (arguments.bounds or [row["bounds"]]) for row in others
    ]
    rows: list[dict[str, Any]] = [row for row, fresh in zip(others, again, strict=True) if not fresh]
    for row in measured(tasks, arguments.episodes, arguments.seed, arguments.runs, arguments.bounds):
        rows.append(row)
        kept.write_text(json.dumps(rows, indent=1) + "\n")
        (arguments.results / "seams.md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
