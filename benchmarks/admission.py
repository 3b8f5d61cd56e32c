"""Admission of chunks: clean ones that are refused, and unreachable ones that pass.

    python -m benchmarks.admission    # 10,000 clean and 10,000 unreachable chunks, one minute

Machines of 1 to 7 axes with random limits on speed, acceleration and jerk (a quarter of them without a limit on the
jerk), in random states, a tenth of ruckig's over their speed limit. A chunk is 2 to 50 position setpoints, and what
admission judges is its end.

Clean chunks are sampled from motions that keep the limits: ruckig's from state to state, at rest or moving at the
end, cut off anywhere or exactly at their end; random motions of piecewise constant jerk; and fastest motions, which
end on the very edge of what can be reached.

Unreachable ends are put beyond an oracle's reach, on one axis and side, by 0.1 % to 100 % of the reach's width. The
oracle shares nothing with the library: it drives the fastest motion of the idealised machine in fine steps (from a
speed over its limit it may stay as fast, or go where its acceleration carries it at the least). Where the jerk is
limited and the speed limit gets in the way, the idealised machine gets farther than a real one, which has to wind its
acceleration down first. So there is a second oracle, ruckig's fastest motion, and the share of ends beyond it that
pass is what idealising costs: those wait for the full check of path, torque and stopping.

Two judges: `admits` with the acceleration of the start, and `LeaseExpiry`, which does not measure it and must count
on the most at once (and so does its oracle).
"""

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import ruckig

import safe_wrappers as sw
from benchmarks.tables import RESULTS, keep, markdown, total
from safe_wrappers.checks import Array
from safe_wrappers.control.watchdog.reachability import admits

FINE = 2000
"""Steps of the oracle's drive; its error is below 0.001 % of the way."""
SUBSTEPS = 4
"""Pieces of constant jerk per control step of a random motion."""


@dataclass
class Machine:
    """Limits and state of every axis, shape (axes,)."""

    speed: Array
    acceleration: Array
    jerk: Array
    position: Array
    velocity: Array
    accelerating: Array


@dataclass
class Case:
    """A machine, a time, and where a chunk ends."""

    machine: Machine
    steps: int
    control_dt: float
    end: Array
    kind: str
    beyond: float = 0.0

    @property
    def time(self) -> float:
        """From now to the end of the last command, s."""
        return self.steps * self.control_dt


def viable(rng: np.random.Generator, speed: Array, acceleration: Array, jerk: Array) -> tuple[Array, Array]:
    """Velocity and acceleration whose past and future keep the limits; no jerk limit, no acceleration to speak of."""
    limited = np.isfinite(jerk)
    j = np.where(limited, jerk, 1.0)
    a = rng.uniform(-1, 1, speed.size) * np.minimum(acceleration, np.sqrt(j * speed)) * limited
    return rng.uniform(-1, 1, speed.size) * (speed - 0.5 * a * a / j), a


def machine(rng: np.random.Generator) -> Machine:
    """Of random size, limits and state."""
    axes = int(rng.integers(1, 8))

    def spread(low: float, high: float) -> Array:
        return np.exp(rng.uniform(math.log(low), math.log(high), axes))

    speed, acceleration, jerk = spread(0.1, 5.0), spread(0.2, 20.0), spread(1.0, 500.0)
    if rng.random() < 0.25:
        jerk[:] = np.inf
    velocity, accelerating = viable(rng, speed, acceleration, jerk)
    return Machine(speed, acceleration, jerk, rng.normal(0.0, 2.0, axes), velocity, accelerating)


def profile(m: Machine, i: int, end: tuple[float, float, float], towards: float = 0.0) -> ruckig.Trajectory:
    """Ruckig's of one axis to an end state, or, with `towards`, the fastest way to full speed in that direction."""
    request, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    if towards:
        request.control_interface = ruckig.ControlInterface.Velocity
        end = (0.0, towards * m.speed[i], 0.0)
    request.current_position, request.current_velocity = [m.position[i]], [m.velocity[i]]
    request.current_acceleration = [m.accelerating[i]]
    request.target_position, request.target_velocity, request.target_acceleration = ([x] for x in end)
    request.max_velocity, request.max_acceleration, request.max_jerk = (
        [m.speed[i]],
        [m.acceleration[i]],
        [m.jerk[i]],
    )
    ruckig.Ruckig(1).calculate(request, trajectory)
    return trajectory


def place(trajectory: ruckig.Trajectory, time: float) -> float:
    """Position at a time, m; after the end of the profile it goes on at constant speed."""
    return float(trajectory.at_time(time)[0][0])


def ruckigs(rng: np.random.Generator) -> Case:
    """A motion of ruckig's, at rest or moving at the end, cut off anywhere, or just as long as it takes."""
    m = machine(rng)
    axes, steps = m.speed.size, int(rng.integers(2, 51))
    if rng.random() < 0.1:
        m.velocity = m.speed * rng.uniform(1.0, 2.0, axes) * rng.choice([-1.0, 1.0], axes)
    time = steps * rng.uniform(0.01, 0.1)
    wanted_v, wanted_a = viable(rng, m.speed, m.acceleration, m.jerk)
    if rng.random() < 0.5:
        wanted_v[:] = 0.0
    goals = m.position + rng.uniform(-1.5, 1.5, axes) * m.speed * time
    # After its end a profile goes on at constant speed: only where the end is not accelerated is that admissible.
    exact = bool(rng.random() < 0.3)
    if not (exact and axes == 1):
        wanted_a[:] = 0.0
    found = [profile(m, i, (goals[i], wanted_v[i], wanted_a[i])) for i in range(axes)]
    if exact:
        time = max(max(t.duration for t in found), 1e-3)
    end = np.array([place(t, time) for t in found])
    return Case(m, steps, time / steps, end, "ruckig, just in time" if exact else "ruckig")


def fastest(rng: np.random.Generator) -> Case:
    """The fastest motion along every axis, either way: the edge of what can be reached."""
    m = machine(rng)
    steps, hold = int(rng.integers(2, 51)), rng.uniform(0.01, 0.1)
    signs = rng.choice([-1.0, 1.0], m.speed.size)
    found = [profile(m, i, (0, 0, 0), towards=sign) for i, sign in enumerate(signs)]
    return Case(m, steps, hold, np.array([place(t, steps * hold) for t in found]), "fastest")


def wandering(rng: np.random.Generator) -> Case:
    """Random pieces of jerk (of acceleration, without a limit on it), taken only where the limits stay kept."""
    m = machine(rng)
    steps, hold = int(rng.integers(2, 51)), rng.uniform(0.01, 0.1)
    dt = hold / SUBSTEPS
    x, v, a = m.position.copy(), m.velocity.copy(), m.accelerating.copy()
    for _ in range(steps * SUBSTEPS):
        wanted = rng.choice([-1.0, 0.0, 1.0, rng.uniform(-1, 1)], x.size)
        if np.isinf(m.jerk[0]):
            faster = np.clip(v + wanted * m.acceleration * dt, -m.speed, m.speed)
            x, v = x + 0.5 * (v + faster) * dt, faster
            continue
        for j, time in _kept(wanted * m.jerk, v, a, m, dt):
            x = x + time * (v + time * (0.5 * a + time / 6.0 * j))
            v, a = v + time * (a + 0.5 * time * j), a + time * j
    return Case(m, steps, hold, x, "random jerk")


def _kept(wanted: Array, v: Array, a: Array, m: Machine, dt: float) -> list[tuple[Array, Array]]:
    """Two pieces of jerk and their times: the wanted one, or the one that takes the acceleration away."""
    jerk, time = -np.sign(a) * m.jerk, np.minimum(np.abs(a) / m.jerk, dt)
    for j in (np.zeros_like(a), wanted):
        a1, v1 = a + j * dt, v + dt * (a + 0.5 * j * dt)
        with np.errstate(divide="ignore", invalid="ignore"):
            between = np.where(a * a1 < 0.0, v - 0.5 * a * a / j, v1)  # where the acceleration changes sign
        ahead = v1 + 0.5 * a1 * np.abs(a1) / m.jerk
        fits = (np.max(np.abs([v1, between, ahead]), axis=0) <= m.speed) & (np.abs(a1) <= m.acceleration)
        jerk, time = np.where(fits, j, jerk), np.where(fits, dt, time)
    return [(jerk, time), (np.zeros_like(a), dt - time)]


def driven(m: Machine, time: Array, measured: bool) -> tuple[Array, Array]:
    """The idealised machine's lowest and highest displacement: throttle fully open, in fine steps, for all axes."""
    dt = time / FINE
    ends = []
    for sign in (-1.0, 1.0):
        v = sign * m.velocity
        # Not measured, it may be the most at once; over the speed limit it must be taken away by the jerk still.
        free = np.isinf(m.jerk) | (~np.full(v.shape, measured) & (v <= m.speed))
        change = np.where(free, 0.0, m.jerk) * dt
        a = np.where(free | (not measured), m.acceleration, sign * m.accelerating)
        top = np.maximum(m.speed, _carried(v, np.where(free, 0.0, a), m.jerk))
        x = highest = np.zeros_like(v)
        for _ in range(FINE):
            a1 = np.minimum(np.maximum(m.acceleration, a), a + change)
            v1 = v + 0.5 * (a + a1) * dt
            x = x + 0.5 * (np.minimum(v, top) + np.minimum(v1, top)) * dt
            v, a, highest = v1, a1, np.maximum(highest, x)
        ends.append(sign * highest)
    return ends[0], ends[1]


def _carried(v: Array, a: Array, jerk: Array) -> Array:
    """The speed that a start cannot avoid: its acceleration wound down in fine steps."""
    winding = np.maximum(a, 0.0)
    dt = np.where(np.isinf(jerk), 0.0, winding / jerk / FINE)
    for k in range(FINE):
        v = v + winding * (1.0 - (k + 0.5) / FINE) * dt
    return v


def pooled(cases: list[Case]) -> tuple[Machine, Array]:
    """All axes of all cases one after the other, and the time of each."""
    names = ("speed", "acceleration", "jerk", "position", "velocity", "accelerating")
    together = Machine(*(np.concatenate([getattr(c.machine, name) for c in cases]) for name in names))
    return together, np.concatenate([np.full(c.machine.speed.size, c.time) for c in cases])


def reaches(cases: list[Case], measured: bool) -> Iterator[tuple[Array, Array]]:
    """The idealised machine's, case by case."""
    low, high = driven(*pooled(cases), measured)
    cuts = np.cumsum([c.machine.speed.size for c in cases])[:-1]
    return zip(np.split(low, cuts), np.split(high, cuts), strict=True)


def beyond(rng: np.random.Generator, case: Case, lowest: Array, highest: Array, on: Array) -> Case:
    """The case with its end moved out of reach on one of the axes, by some of the reach's width."""
    i = int(rng.choice(on))
    share = float(np.exp(rng.uniform(math.log(1e-3), 0.0)))
    width = highest[i] - lowest[i]
    way = highest[i] + share * width if rng.random() < 0.5 else lowest[i] - share * width
    end = case.end.copy()
    end[i] = case.machine.position[i] + way
    return Case(case.machine, case.steps, case.control_dt, end, case.kind, share)


def real_reach(m: Machine, time: float, i: int) -> tuple[float, float]:
    """Of one axis with limited jerk, by ruckig's fastest motions either way."""
    ends = []
    for sign in (-1.0, 1.0):
        found = profile(m, i, (0, 0, 0), towards=sign)
        ways = [sign * (place(found, t) - m.position[i]) for t in np.linspace(0.0, time, 200)]
        ends.append(sign * max(ways))
    return ends[0], ends[1]


def by_function(case: Case) -> bool:
    """`admits`, with the acceleration of the start."""
    m = case.machine
    state = (case.end, m.position, m.velocity, case.time)
    return bool(admits(*state, m.speed, m.acceleration, m.jerk, m.accelerating).all())


class Still(gym.Env[Any, Any]):
    """Nothing but an action space: the wrapper is asked, never stepped."""

    def __init__(self, axes: int) -> None:
        self.action_space = gym.spaces.Box(-1.0, 1.0, (axes,))
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (1,))


def by_wrapper(case: Case) -> bool:
    """`LeaseExpiry`, which reads positions and velocities only."""
    m = case.machine
    limits = {"max_speed": m.speed, "max_acceleration": m.acceleration, "max_jerk": m.jerk}
    wrapper = sw.LeaseExpiry(
        Still(m.speed.size),
        sw.StoppingBudget(lambda env: (1.0, 0.0), braking=1.0, acceleration=0.0),
        motion_limits={name: limit.tolist() for name, limit in limits.items()},
        measured=lambda env: (m.position, m.velocity),
        max_lease_s=max(1.0, case.control_dt),
        fallback="zero",
        control_dt=case.control_dt,
    )
    return wrapper.admits(case.end, case.steps)


JUDGES: dict[str, Callable[[Case], bool]] = {"admits": by_function, "LeaseExpiry": by_wrapper}


def clean(rng: np.random.Generator, count: int) -> Iterator[Case]:
    """Cases of every kind in turn."""
    kinds = (ruckigs, wandering, ruckigs, fastest)
    for k in range(count):
        yield kinds[k % len(kinds)](rng)


def judged(seed: int, count: int) -> list[dict[str, Any]]:
    """One row per judge and kind of chunk."""
    rows: dict[tuple[str, str, str], dict[str, Any]] = {}

    def note(judge: str, group: str, case: Case) -> None:
        key = (judge, group, case.kind)
        row = rows.setdefault(
            key,
            {"judge": judge, "group": group, "kind": case.kind, "chunks": 0, "refused": 0, "closest": None},
        )
        row["chunks"] += 1
        refused = not JUDGES[judge](case)
        row["refused"] += int(refused)
        if case.beyond:
            row["closest"] = min(row["closest"] or math.inf, case.beyond)

    for case in clean(np.random.default_rng([seed, 0]), count):
        for judge in JUDGES:
            note(judge, "clean", case)
    rng = np.random.default_rng([seed, 1])
    moved = list(clean(np.random.default_rng([seed, 2]), count))
    for case, (low, high) in zip(moved, reaches(moved, measured=True), strict=True):
        m = case.machine
        every = np.arange(m.speed.size)
        note("admits", "unreachable", beyond(rng, case, low, high, every))
        if not (np.isfinite(m.jerk).all() and (np.abs(m.velocity) <= m.speed).all()):
            continue
        real = np.array([real_reach(m, case.time, i) for i in every])
        met = np.flatnonzero(high - low > 1.0001 * (real[:, 1] - real[:, 0]))
        if met.size:
            note("admits", "beyond the real reach", beyond(rng, case, real[:, 0], real[:, 1], met))
    for case, (low, high) in zip(moved, reaches(moved, measured=False), strict=True):
        note("LeaseExpiry", "unreachable", beyond(rng, case, low, high, np.arange(low.size)))
    return list(rows.values())


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per judge, group and kind of motion, and the sums."""
    lines = []
    for r in rows:
        counts = (f"{count:,}" for count in (r["chunks"], r["refused"], r["chunks"] - r["refused"]))
        closest = "-" if r["closest"] is None else f"{r['closest']:.2%}"
        lines.append([r["judge"], r["group"], r["kind"], *counts, closest])
    said = []
    for judge in JUDGES:
        for group in ("clean", "unreachable", "beyond the real reach"):
            part = [r for r in rows if (r["judge"], r["group"]) == (judge, group)]
            if part:
                refused, count = total(part, "refused"), total(part, "chunks")
                said.append(f"- {judge}, {group}: {refused:,} of {count:,} refused.")
    head = "judge | chunks | made from | count | refused | passed | closest"
    return "\n".join([markdown(head, lines), "", *said])


def main() -> None:
    """Judge, print the table, keep the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--chunks", type=int, default=10_000, help="clean, and as many unreachable")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rows = judged(arguments.seed, arguments.chunks)
    keep(RESULTS, "admission", rows, table(rows))


if __name__ == "__main__":
    main()
