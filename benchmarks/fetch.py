"""Fetch arms under adversarial drivers, with the filter and without: gripper out of its box, table or ball touched.

    python -m benchmarks.fetch                   # 100,000 steps with the filter, 20,000 without, over 4 envs
    python -m benchmarks.fetch --steps 400000    # 100,000 per env

A violation is a control step in which, after any of its 20 physics substeps, the env's own positions
(`benchmarks/fetch_judge.py`) had the gripper outside its box, anything of the robot in contact with the table
(MuJoCo's contacts begin at 1 mm), or a finger in a ball that stands in the way. Half of each driver's steps are
episodes of 50 steps, half of 1,000. FetchPush and FetchSlide start with the fingers in the table; steps until they
have left it are counted apart ("coming free"), 10 per episode at most. Times are of the processor, not of the
clock: what `step` takes beyond the env's own.
"""

import argparse
import multiprocessing
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import numpy as np

import safe_wrappers as sw
from benchmarks import chunks
from benchmarks.fetch_drivers import drivers, obstacles
from benchmarks.fetch_judge import FetchJudge
from benchmarks.tables import RESULTS, markdown, total
from safe_wrappers.errors import UnsafeStateWarning

ENVS = ("FetchReach-v4", "FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4")
EPISODES = (50, 1000)
_FLAGS = ("intervened", "infeasible", "fallback", "unsafe")


@dataclass(frozen=True)
class Job:
    """One driver on one env for so many steps, in episodes of one length."""

    env_id: str
    driver: str
    filtered: bool
    episode_steps: int
    steps: int
    seed: int


def run(job: Job) -> dict[str, Any]:
    """Drive, judge and count."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted below
    gym.register_envs(gymnasium_robotics)
    bare = gym.make(job.env_id, max_episode_steps=job.episode_steps)
    raw: Any = bare.unwrapped
    env: Any = sw.protect(bare, keep_out=obstacles(raw)) if job.filtered else bare
    judge = FetchJudge(raw, ball=True)
    driver = drivers(ball=True)[job.driver](raw, np.random.default_rng(job.seed))
    count = dict.fromkeys(("violations", "unflagged", *_FLAGS), 0)
    spent: dict[bool, list[float]] = {False: [], True: []}
    inner = _timed(raw)
    worst, episode, over = -np.inf, job.seed * 100_000, True
    for _ in range(job.steps):
        if over:
            env.reset(seed=episode)
            if judge.start() > 0.0:
                raise RuntimeError(f"{job.env_id} does not start where the judge lets it")
            episode += 1
        action = np.asarray(driver(), dtype=np.float32)
        judge.before()
        begin = time.process_time()
        _, _, terminated, truncated, info = env.step(action)
        beyond = time.process_time() - begin - inner[0]
        missed = judge.after(action, info)
        worst, violated = max(worst, missed), not missed <= 0.0  # so that what is not a number counts
        count["violations"] += int(violated)
        if job.filtered:
            for name in _FLAGS:
                count[name] += int(info[f"cbf/{name}"])
            flagged = info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"]
            count["unflagged"] += int(violated and not flagged)
            spent[bool(info["cbf/intervened"])].append(beyond)
        over = terminated or truncated
    times = {
        f"{name}_us": 1e6 * float(np.median(spent[changed])) if spent[changed] else None
        for name, changed in (("unchanged", False), ("changed", True))
    }
    every = [*spent[False], *spent[True]]
    times["filter_us"] = 1e6 * float(np.mean(every)) if every else None
    return asdict(job) | count | times | {"coming_free": judge.excused, "worst_m": float(worst)}


def _timed(raw: Any) -> list[float]:
    """Where the processor time of the unwrapped env's last step will be found, s."""
    found, step = [0.0], raw.step

    def timed(action: Any) -> Any:
        begin = time.process_time()
        answer = step(action)
        found[0] = time.process_time() - begin
        return answer

    raw.step = timed
    return found


def jobs(arguments: argparse.Namespace) -> list[Job]:
    """What to run: the steps are split between envs, drivers and lengths of episodes."""
    envs = [e for e in ENVS if not arguments.envs or any(word in e for word in arguments.envs)]
    names = [n for n in drivers(ball=True) if not arguments.drivers or n in arguments.drivers]
    parts = len(envs) * len(names) * len(EPISODES)
    return [
        Job(env_id, name, filtered, length, -(-steps // parts), arguments.seed + k)
        for filtered, steps in ((False, arguments.off), (True, arguments.steps))
        for k, length in enumerate(EPISODES)
        for name in names
        for env_id in envs
    ]


def _line(name: str, driver: str, part: list[dict[str, Any]]) -> list[str]:
    on, off = [r for r in part if r["filtered"]], [r for r in part if not r["filtered"]]
    steps = total(on, "steps")
    cells = [
        name,
        driver,
        f"{steps:,}",
        f"{total(off, 'violations') / max(total(off, 'steps'), 1):.1%}",
        f"{total(on, 'violations'):,}",
        f"{total(on, 'unflagged'):,}",
        f"{total(on, 'intervened') / max(steps, 1):.1%}",
        f"{total(on, 'infeasible'):,}",
        f"{total(on, 'fallback'):,}",
        f"{total(on, 'coming_free'):,}",
        f"{-1e3 * max((r['worst_m'] for r in on), default=np.nan):.2f}",
        *(_microseconds(on, which) for which in ("unchanged_us", "changed_us", "filter_us")),
    ]
    return cells


def _microseconds(rows: list[dict[str, Any]], which: str) -> str:
    found = [row[which] for row in rows if row[which] is not None]
    return f"{np.median(found):,.0f}" if found else "-"


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per env and driver, one per env, one for all."""
    lines = []
    for env_id in sorted({row["env_id"] for row in rows}, key=ENVS.index):
        of_env = [row for row in rows if row["env_id"] == env_id]
        for driver in dict.fromkeys(row["driver"] for row in of_env):
            lines.append(_line(env_id, driver, [row for row in of_env if row["driver"] == driver]))
        lines.append(_line(env_id, "all", of_env))
    head = "env | driver | steps | violations off | on | unflagged | changed | infeasible | fallback | coming free"
    times = "filter, unchanged (us) | changed (us) | mean (us)"
    return markdown(f"{head} | least room (mm) | {times}", [*lines, _line("all", "all", rows)])


def main() -> None:
    """Run the jobs, write rows and table, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000, help="with the filter, in all")
    parser.add_argument("--off", type=int, default=20_000, help="steps without it, in all")
    parser.add_argument("--envs", nargs="+", help="words; an env whose name has one of them is run")
    parser.add_argument("--drivers", nargs="+", help="names; all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    parser.add_argument(
        "--resume", action="store_true", help="keep the rows of a killed run of the same command"
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the rows and the table")
    arguments = parser.parse_args()
    wanted = jobs(arguments)
    arguments.results.mkdir(parents=True, exist_ok=True)
    path = arguments.results / "fetch.jsonl"
    found = chunks.known(path, Job) if arguments.resume else {}
    kept = {job: found[job] for job in wanted if job in found}
    rows = chunks.measured(path, wanted, run, arguments.workers, kept)
    text = table([rows[job] for job in wanted])
    (arguments.results / "fetch.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
