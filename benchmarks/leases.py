"""Leases on a cart that drives at a wall while its policy drops out: contacts with and without, and how tight.

    python -m benchmarks.leases    # 6 x 10,000 episodes, half an hour; goes on where it was stopped

Episodes with outages. Speed, clearance, throttle, brakes, reading errors and all five delays are drawn for each. The
policy knows where to brake for the wall, so that it never touches it while it lives; the commands that it sends are
lost in outages of random length at random times (`safe_wrappers.wrappers.faults.Outages`), the same with and without
the lease. Without one the cart goes on with the last command, as a motor drive does.

Worst cases. The policy dies right after a lease was granted, at full throttle or rolling head on, with every reading
too long by the whole bound, every delay used up and brakes not a bit better than declared. Once under the lease of
`control/watchdog/leases.py`, once under one that is 5 % longer. Clearances are drawn so that a lease is a whole
number of control steps (at least 20: a twentieth is one step), since it only ever runs out between two of them.
"""

import argparse
import json
import math
import multiprocessing
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np

import safe_wrappers as sw
from benchmarks.cart_and_wall import HOLD_S, PHYSICS_S, CartAndWall, Drive
from benchmarks.tables import RESULTS, markdown
from safe_wrappers.control.watchdog.leases import longest_lease
from safe_wrappers.wrappers.faults import Outages

BLOCK = 500
"""Episodes per row of the results."""
LONGEST_EPISODE_S = 20.0
LONGEST_HEAD_ON_S = 8.0
"""A policy that never brakes creeps up to the wall and never arrives."""
MODES = {
    "alive": "policy without outages, no lease",
    "no lease": "outages, no lease",
    "lease": "outages, lease",
    "head on": "outages, lease, policy that never brakes",
    "worst": "worst case, lease of the formula",
    "worst, 5 % longer": "worst case, lease 5 % longer",
}


@dataclass(frozen=True)
class Job:
    """A block of episodes."""

    mode: str
    block: int
    episodes: int = BLOCK


def way(drive: Drive, after_s: float) -> float:
    """What the cart needs from a reading to rest if it brakes so long after it, m: by phases, not by our library."""
    speed, top = drive.speed, max(drive.top_speed, drive.speed)
    rising = min(after_s, (top - speed) / drive.acceleration) if drive.acceleration > 0.0 else after_s
    end = speed + drive.acceleration * rising
    rolled = rising * 0.5 * (speed + end) + (after_s - rising) * end
    return rolled + 0.5 * end * end / drive.braking + drive.localisation + drive.margin


def whole(rng: np.random.Generator, most_s: float) -> float:
    """A delay in whole physics steps."""
    return PHYSICS_S * int(rng.integers(0, round(most_s / PHYSICS_S) + 1))


def drawn(rng: np.random.Generator, worst: bool) -> Drive:
    """An episode, started where a stop is possible; a third of them roll and have no throttle."""
    speed = rng.uniform(0.2, 3.0)
    rolling = rng.random() < 1 / 3
    drive = Drive(
        clearance=0.0,
        speed=speed,
        braking=rng.uniform(1.0, 8.0),
        brakes_better=1.0 if worst else rng.uniform(1.0, 1.3),
        acceleration=0.0 if rolling else rng.uniform(0.3, 4.0),
        top_speed=speed + rng.uniform(0.0, 2.0),
        detect_s=whole(rng, 0.1),
        confirm_s=whole(rng, 0.1),
        age_s=whole(rng, 0.15),
        act_s=whole(rng, 0.15),
        localisation=rng.uniform(0.0, 0.1),
        margin=0.0 if worst else rng.uniform(0.0, 0.2),
        longest_s=10.0 if worst else rng.uniform(0.1, 2.0),
        run_up=1.0 if worst else 0.0,
        bias=1.0 if worst else None,
    )
    delays = drive.to_brake_s + drive.age_s
    if worst:
        # The reading is too long by the bound, so the true clearance is less by it; 0.05 mm for what the last physics
        # step of braking, which ends at rest and not before, takes more than the formula.
        lease = HOLD_S * int(rng.integers(20, 101))
        room = way(drive, lease + delays) - drive.localisation + 5e-5
    else:
        room = way(drive, delays) + rng.uniform(0.0, 8.0)
    return Drive(**{**drive.__dict__, "clearance": room})


def full_brake(plant: Any) -> list[float]:
    """The fallback."""
    return [-1.0]


def stack(mode: str, drive: Drive, outages: tuple[float, float]) -> tuple[Any, CartAndWall]:
    """The env that the policy drives, and the cart itself."""
    cart = CartAndWall()
    env: Any = cart
    if mode not in ("alive", "no lease"):
        env = sw.LeaseExpiry(
            cart,
            sw.StoppingBudget(
                cart.reading,
                braking=drive.braking,
                acceleration=drive.acceleration,
                top_speed=drive.top_speed,
                act_s=drive.act_s,
                localisation=drive.localisation,
                margin=drive.margin,
            ),
            detect_s=drive.detect_s,
            confirm_s=drive.confirm_s,
            age_s=drive.age_s,
            max_lease_s=drive.longest_s,
            fallback=full_brake,
        )
    if mode in ("no lease", "lease", "head on"):
        env = Outages(env, mean_between_s=outages[0], mean_length_s=outages[1])
    return env, cart


def policy(drive: Drive, reading: Any, braking: bool) -> float:
    """Full throttle until the reading says brake: a lease of two control steps would not be left."""
    room, speed = float(reading[0]), float(reading[1])
    needed = way(Drive(**{**drive.__dict__, "speed": speed}), drive.to_brake_s + drive.age_s + 3.0 * HOLD_S)
    return -1.0 if braking or room <= needed else 1.0


def episode(mode: str, seed: tuple[int, ...]) -> dict[str, Any]:
    """One drive at the wall, until it stands by its own will, touches, or time is up."""
    rng = np.random.default_rng(seed)
    drive = drawn(rng, worst=False)
    outages = rng.uniform(0.3, 2.0), rng.uniform(0.2, 2.0)
    env, cart = stack(mode, drive, outages)
    reading, _ = env.reset(seed=int(rng.integers(2**31)), options={"drive": drive})
    braking, braked_by_lease, steps = False, 0, 0
    longest_s = LONGEST_HEAD_ON_S if mode == "head on" else LONGEST_EPISODE_S
    while steps * HOLD_S < longest_s:
        command = 1.0 if mode == "head on" else policy(drive, reading, braking)
        braking = command < 0.0
        reading, _, touched, _, info = env.step(np.array([command]))
        steps += 1
        braked_by_lease += int(info.get("lease/braking", False))
        if touched or (cart.at_rest and (braking or drive.acceleration == 0.0)):
            break
    return {
        "contact": cart.touched,
        "lowest": cart.lowest - drive.margin,
        "arrived": bool(cart.at_rest and braking),
        "seconds": steps * HOLD_S,
        "braked": braked_by_lease,
        "steps": steps,
    }


def worst_case(longer: float, seed: tuple[int, ...]) -> dict[str, Any]:
    """The policy sends one command and dies."""
    drive = drawn(np.random.default_rng(seed), worst=True)
    env, cart = stack("worst", drive, (1.0, 1.0))
    env.reset(options={"drive": drive})
    steps = 0
    with mock.patch(
        "safe_wrappers.wrappers.stopping_budget.longest_lease",
        lambda *a, **k: longer * longest_lease(*a, **k),
    ):
        while not (cart.touched or cart.at_rest):
            _, _, _, _, info = env.step(np.array([1.0]))
            env.set_observation_time(None)
            steps += 1
            if steps == 1 and info["lease/braking"]:
                raise AssertionError("the first command got no lease")
    return {
        "contact": cart.touched,
        "lowest": cart.lowest,
        "arrived": False,
        "seconds": steps * HOLD_S,
        "braked": 0,
        "steps": steps,
    }


def run(job: Job) -> dict[str, Any]:
    """All episodes of a block, summed up."""
    rows = []
    for k in range(job.block * BLOCK, job.block * BLOCK + job.episodes):
        if job.mode.startswith("worst"):
            rows.append(worst_case(1.0 if job.mode == "worst" else 1.05, (1, k)))
        else:
            rows.append(episode(job.mode, (0, k)))  # the same episodes in all modes
    arrived = [r["seconds"] for r in rows if r["arrived"]]
    return {
        "mode": job.mode,
        "block": job.block,
        "episodes": len(rows),
        "contacts": sum(r["contact"] for r in rows),
        "arrived": len(arrived),
        "arrived_s": sum(arrived),
        "lowest_m": min(r["lowest"] for r in rows),
        "highest_m": max(r["lowest"] for r in rows),
        "steps": sum(r["steps"] for r in rows),
        "braked_steps": sum(r["braked"] for r in rows),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per mode."""
    lines = []
    summed = ("episodes", "contacts", "arrived", "arrived_s", "steps", "braked_steps")
    for mode, title in MODES.items():
        part = [r for r in rows if r["mode"] == mode]
        if not part:
            continue
        total = {k: sum(r[k] for r in part) for k in summed}
        contacts = f"{total['contacts']:,} ({total['contacts'] / total['episodes']:.1%})"
        lowest = f"{1e3 * min(r['lowest_m'] for r in part):.2f}"
        if mode == "worst":
            lowest += f" to {1e3 * max(r['highest_m'] for r in part):.2f}"
        if total["contacts"]:
            lowest = "-"  # it ends at the wall
        arrives = mode in ("alive", "no lease", "lease")
        arrived = f"{total['arrived'] / total['episodes']:.1%}" if arrives else "-"
        time = f"{total['arrived_s'] / total['arrived']:.2f}" if arrives and total["arrived"] else "-"
        braked = f"{total['braked_steps'] / total['steps']:.1%}" if mode in ("lease", "head on") else "-"
        lines.append([title, f"{total['episodes']:,}", contacts, lowest, arrived, time, braked])
    return markdown(
        "episodes | count | contacts | least clearance over the margin (mm) | arrived | mean time (s) | braked",
        lines,
    )


def main() -> None:
    """Run what is missing, keep every block, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10_000, help="per mode, in blocks of 500")
    parser.add_argument("--mode", nargs="+", default=list(MODES), choices=list(MODES))
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    arguments = parser.parse_args()
    RESULTS.mkdir(exist_ok=True)
    kept = RESULTS / "leases.json"
    rows: list[dict[str, Any]] = json.loads(kept.read_text()) if kept.exists() else []
    done = {(r["mode"], r["block"]) for r in rows}
    blocks = range(math.ceil(arguments.episodes / BLOCK))
    jobs = [Job(m, b) for b in blocks for m in arguments.mode if (m, b) not in done]
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        for row in pool.imap_unordered(run, jobs):
            rows.append(row)
            kept.write_text(json.dumps(rows, indent=1) + "\n")
            (RESULTS / "leases.md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
