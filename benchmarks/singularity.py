"""Manipulability against SVD, and what a Cartesian policy does near a singular pose with the constraint and without.

    python -m benchmarks.singularity                  # everything, some ten minutes
    python -m benchmarks.singularity --part paths     # one of: measure, paths, attacks

Measure. 10,000 configurations of each arm, uniform in the joints' ranges: w by QR, as the library has it, against
the product of singular values of MuJoCo's own Jacobian; beside it the square root of the determinant of J J'. Then
10,000 of Reacher's ever closer to its stretched pose (10^-1 to 10^-8 rad) against the closed form. The time is that
of a batch.

Paths. On Reacher a resolved-rate policy (`rates = J^-1 (velocity + 10 x error)`, a velocity loop in torques) follows
lines that pass near the base, where the arm folds, and circles that touch the reach of the stretched arm. "damped" is
the usual remedy in the policy itself: damped least squares (Nakamura and Hanafusa 1986). On FetchReach the policy
displaces the hand along lines out of reach and back; the env's weld is its inverse. Thresholds are validated by the
constraint for the task speed and rate limit in the table. Judged at every physics substep, by MuJoCo's own Jacobian.

Attacks. Random actions, full actions held for 9 steps, pulses, and a driver that looks at w or drives out of reach;
a violation is a step with w below the threshold at any substep, unflagged if the filter reports neither
infeasible or fallback nor an unsafe start. The filter's time is CPU time per step.
"""

import argparse
import json
import multiprocessing
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any
from unittest import mock

import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks.arms import ARMS, Arm, Truth, watch
from benchmarks.tables import RESULTS, keep, markdown
from safe_wrappers.control.filtering.manipulability import manipulability
from safe_wrappers.errors import UnsafeStateWarning

SPEED = {"Reacher": 0.1, "Fetch": 0.15}
"""Along the paths, m/s."""
DAMPING = 0.03
"""Of the damped least squares, m/rad."""
GAIN = 10.0
"""Of the tracking error, 1/s."""

REPEATS = 7
"""Of a measurement of time; the least counts."""

# Measure ------------------------------------------------------------------------------------------------------


def by_determinant(jacobians: np.ndarray) -> np.ndarray:
    """The formula as it stands."""
    return np.asarray(np.sqrt(np.linalg.det(jacobians @ np.swapaxes(jacobians, 1, 2))))


def by_svd(jacobians: np.ndarray) -> np.ndarray:
    """Product of the singular values."""
    return np.asarray(np.prod(np.linalg.svd(jacobians, compute_uv=False), axis=-1))


WAYS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "qr": manipulability,
    "svd": by_svd,
    "determinant": by_determinant,
}


def measure(count: int, seed: int = 0) -> list[dict[str, Any]]:
    """Errors and times per arm, and near Reacher's stretched pose."""
    rows = []
    for name, arm in ARMS.items():
        truth = Truth(arm, arm.make())
        qpos = truth.sample(np.random.default_rng(seed), count)
        jacobians = np.array([truth.jacobian(q) for q in qpos])
        rows.append({"what": name, **_compared(jacobians, by_svd(jacobians))})
    arm = ARMS["Reacher"]
    truth = Truth(arm, arm.make())
    rng = np.random.default_rng(seed)
    qpos = truth.sample(rng, count)
    qpos[:, truth.qpos[1]] = 10.0 ** rng.uniform(-8.0, -1.0, count)
    jacobians = np.array([truth.jacobian(q) for q in qpos])
    closed = 0.1 * 0.11 * np.sin(qpos[:, truth.qpos[1]])
    rows.append(
        {"what": "Reacher, nearly stretched, against the closed form", **_compared(jacobians, closed)}
    )
    return rows


def _compared(jacobians: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    row: dict[str, Any] = {
        "count": len(jacobians),
        "shape": list(jacobians.shape[1:]),
        "least": float(truth.min()),
    }
    with np.errstate(invalid="ignore"):
        for way, function in WAYS.items():
            spent = []
            for _ in range(REPEATS):
                began = time.perf_counter()
                found = function(jacobians)
                spent.append(time.perf_counter() - began)
            row[f"{way}_us"] = 1e6 * min(spent) / len(jacobians)
            row[f"{way}_failed"] = int((~np.isfinite(found)).sum())
            row[f"{way}_error"] = float(np.nanmax(np.abs(found / truth - 1.0)))
    return row


# Paths --------------------------------------------------------------------------------------------------------

Path2 = Callable[[float], np.ndarray]
"""Time in s to a place, m."""


def reacher_path(kind: str, rng: np.random.Generator) -> tuple[Path2, float]:
    """A path in the plane and how long it takes, s."""
    angle, speed = rng.uniform(-np.pi, np.pi), SPEED["Reacher"]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if kind == "past the base":
        aside = rng.uniform(0.003, 0.03)
        return lambda t: turn @ np.array([-0.15 + speed * t, aside]), 0.3 / speed
    radius, farthest = 0.04, rng.uniform(0.207, 0.2115)
    middle = np.array([farthest - radius, 0.0])

    def circle(t: float) -> np.ndarray:
        phase = np.pi + speed * t / radius
        return np.asarray(turn @ (middle + radius * np.array([np.cos(phase), np.sin(phase)])))

    return circle, 2.0 * np.pi * radius / speed


def fetch_path(start: np.ndarray, rng: np.random.Generator) -> tuple[Path2, float]:
    """From a place out of reach and back."""
    azimuth, rise, length = rng.uniform(-1.0, 1.0), rng.uniform(-0.2, 0.8), rng.uniform(0.25, 0.35)
    towards = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
    there = length / SPEED["Fetch"]

    def line(t: float) -> np.ndarray:
        share = max(min(t / there, 2.0 - t / there), 0.0)
        return np.asarray(start + share * length * towards)

    return line, 2.0 * there


def elbow(place: np.ndarray, side: float) -> np.ndarray:
    """Reacher's joints for a place that it reaches."""
    a, b = 0.1, 0.11
    bend = side * np.arccos(np.clip((place @ place - a * a - b * b) / (2.0 * a * b), -1.0, 1.0))
    first = np.arctan2(place[1], place[0]) - np.arctan2(b * np.sin(bend), a + b * np.cos(bend))
    return np.array([first, bend])


def torques(truth: Truth, raw: Any, wanted: np.ndarray, damped: bool) -> np.ndarray:
    """Resolved rates, and a velocity loop for them (inertia 1 kg m^2, damping 1 N m s, gear 200)."""
    j = truth.jacobian(raw.data.qpos)
    if damped:
        rates = j.T @ np.linalg.solve(j @ j.T + DAMPING**2 * np.eye(2), wanted)
    else:
        rates = np.linalg.pinv(j) @ wanted
    speeds = raw.data.qvel[truth.dofs]
    return np.asarray(np.clip((25.0 * (rates - speeds) + rates) / 200.0, -1.0, 1.0))


MODES = ("off", "damped", "speeds", "margin", "both")


@dataclass(frozen=True)
class PathJob:
    """Paths of a kind under one mode."""

    arm: str
    kind: str
    mode: str
    paths: int


def constraints(arm: Arm, mode: str) -> list[Any]:
    """Of a mode."""
    speeds = sw.constraints.JointSpeedLimit(arm.rate_limit, list(arm.joints), margin=0.01 * arm.rate_limit)
    chosen = {"speeds": [speeds], "margin": [arm.margin()], "both": [speeds, arm.margin()]}
    return chosen.get(mode, [])


def on_cpu_time(run: Callable[[Any], dict[str, Any]], job: Any) -> dict[str, Any]:
    """Run a job with the filter's clock counting this process alone: others share the machine."""
    with mock.patch.object(time, "perf_counter", time.process_time):
        return run(job)


def follow(job: PathJob) -> dict[str, Any]:
    """Follow the paths, and sum up."""
    warnings.simplefilter("ignore", UnsafeStateWarning)
    arm = ARMS[job.arm]
    env = arm.make()
    truth = Truth(arm, env)
    seen = watch(env, truth)
    raw = env.unwrapped
    probe = sw.CBFActionFilter(arm.make(), [arm.margin()]).constraints[0]
    validated = probe.validated
    chosen = constraints(arm, job.mode)
    if chosen:
        env = sw.CBFActionFilter(env, chosen)
    w: list[float] = []
    rates: list[float] = []
    errors: list[float] = []
    count = dict.fromkeys(("steps", "changed", "infeasible", "unsafe", "below", "unflagged"), 0)
    for k in range(job.paths):
        rng = np.random.default_rng(k)
        env.reset(seed=k)
        if job.arm == "Reacher":
            path, lasts = reacher_path(job.kind, rng)
            joints = elbow(path(0.0), float(rng.choice([-1.0, 1.0])))
            raw.set_state(np.concatenate([joints, raw.data.qpos[2:]]), np.zeros(raw.model.nv))
        else:
            env.step(np.zeros(4, np.float32))
            path, lasts = fetch_path(truth.place(), rng)
        hold = raw.dt
        for i in range(int(lasts / hold)):
            here, now, ahead = truth.place(), path(i * hold), path((i + 1) * hold)
            if job.arm == "Reacher":
                wanted = (ahead - now) / hold + GAIN * (now - here[:2])
                action = torques(truth, raw, wanted, job.mode == "damped")
            else:
                action = np.append(np.clip((ahead - here) / 0.05, -1.0, 1.0), 0.0)
            info = env.step(action.astype(np.float32))[4]
            w += seen.w
            rates += seen.rate
            errors.append(float(np.linalg.norm(truth.place()[: len(ahead)] - ahead)))
            flagged = bool(info.get("cbf/infeasible", False) or info.get("cbf/fallback", False))
            below = min(seen.w) < validated.threshold * (1.0 - 1e-6)
            count["steps"] += 1
            count["changed"] += bool(info.get("cbf/intervened", False))
            count["infeasible"] += flagged
            count["unsafe"] += bool(info.get("cbf/unsafe", False))
            count["below"] += below
            count["unflagged"] += below and not (flagged or info.get("cbf/unsafe", False))
    sized = np.array(rates)
    spent = 1e6 * env.filter_seconds / env.filter_calls if chosen else 0.0
    return {
        **asdict(job),
        **{name: int(n) for name, n in count.items()},
        "threshold": validated.threshold,
        "unseen": validated.unseen(),
        "peak": float(sized.max()),
        "p999": float(np.quantile(sized, 0.999)),
        "over": float((sized > arm.rate_limit).mean()),
        "time_below": float((np.array(w) < validated.threshold * (1.0 - 1e-6)).mean()),
        "error_rms": float(np.sqrt(np.mean(np.square(errors)))),
        "error_max": float(np.max(errors)),
        "filter_us": spent,
    }


def path_jobs(paths: int) -> list[PathJob]:
    """Every mode on every kind of path; Fetch's inverse is the env's, so nothing there can be damped."""
    kinds = [("Reacher", "past the base"), ("Reacher", "full stretch"), ("Fetch", "out of reach and back")]
    return [PathJob(a, k, m, paths) for a, k in kinds for m in MODES if (a, m) != ("Fetch", "damped")]


# Attacks ------------------------------------------------------------------------------------------------------

AWAY = np.array([[2.5, 0.75, 0.5], [1.3, 1.9, 0.5], [1.3, 0.75, 1.8], [1.9, 0.75, 1.0], [0.6, 0.75, 1.0]])
"""Places that Fetch does not reach, or only folded."""
DRIVERS = ("random", "held", "pulse", "seeking")


@dataclass(frozen=True)
class AttackJob:
    """One driver on one arm."""

    arm: str
    driver: str
    filtered: bool
    steps: int
    seed: int = 0


class Attacker:
    """One of `DRIVERS`, seeded."""

    def __init__(self, job: AttackJob, truth: Truth, env: Any) -> None:
        self._job, self._truth, self._env, self._raw = job, truth, env, env.unwrapped
        self._rng = np.random.default_rng((job.seed, DRIVERS.index(job.driver)))
        self._probe, self._k, self._held = mujoco.MjData(truth.model), 0, np.zeros(env.action_space.shape)

    def act(self) -> np.ndarray:
        """The next action."""
        space, rng, k = self._env.action_space, self._rng, self._k
        self._k += 1
        if self._job.driver == "random":
            return np.asarray(rng.uniform(space.low, space.high))
        if self._job.driver in ("held", "pulse"):
            each = 9 if self._job.driver == "held" else 20
            if k % each == 0:
                self._held = space.high * rng.choice([-1.0, 1.0], space.shape)
            return self._held if self._job.driver == "held" or k % each < 4 else 0.0 * self._held
        if self._job.arm == "Fetch":
            away = AWAY[(k // 30) % len(AWAY)] - self._truth.place()
            return np.append(np.clip(away / 0.05, -1.0, 1.0), 0.0)
        tried = [space.high * rng.choice([-1.0, 1.0], space.shape) for _ in range(5)]
        return np.asarray(min(tried, key=self._ahead))

    def _ahead(self, control: np.ndarray) -> float:
        """Manipulability after two steps of it."""
        data, raw = self._probe, self._raw
        mujoco.mj_copyData(data, raw.model, raw.data)
        data.ctrl[:] = control
        mujoco.mj_step(raw.model, data, nstep=2 * raw.frame_skip)
        return self._truth.w(data.qpos)


def attack(job: AttackJob) -> dict[str, Any]:
    """Drive episodes of 200 steps, and count."""
    warnings.simplefilter("ignore", UnsafeStateWarning)
    arm = ARMS[job.arm]
    env = arm.make()
    truth = Truth(arm, env)
    seen = watch(env, truth)
    threshold = sw.CBFActionFilter(arm.make(), [arm.margin()]).constraints[0].validated.threshold
    if job.filtered:
        # From full speed Reacher's arm takes longer to brake than any sensible look-ahead.
        speeds = [sw.constraints.JointSpeedLimit(10.0, margin=0.1)] if job.arm == "Reacher" else []
        env = sw.CBFActionFilter(env, [*speeds, arm.margin()])
    attacker = Attacker(job, truth, env)
    count = dict.fromkeys(("changed", "infeasible", "unsafe", "below", "unflagged"), 0)
    least, returned = np.inf, False
    for step in range(job.steps):
        if step % 200 == 0:
            env.reset(seed=job.seed * 1000 + step)
            returned = False
        info = env.step(attacker.act().astype(env.action_space.dtype))[4]
        flagged = bool(info.get("cbf/infeasible", False) or info.get("cbf/fallback", False))
        unsafe = bool(info.get("cbf/unsafe", False))
        share = min(seen.w) / threshold
        below = share < 1.0 - 1e-6
        count["changed"] += bool(info.get("cbf/intervened", False))
        count["infeasible"] += flagged
        count["unsafe"] += unsafe
        count["below"] += below
        count["unflagged"] += below and not (flagged or unsafe)
        if returned:
            least = min(least, share)
        returned |= not below
    spent = 1e6 * env.filter_seconds / env.filter_calls if job.filtered else 0.0
    return {
        **asdict(job),
        **{name: int(n) for name, n in count.items()},
        "threshold": threshold,
        "least": float(least),
        "filter_us": spent,
    }


# Tables -------------------------------------------------------------------------------------------------------


def measure_table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = []
    for r in rows:
        svd = "-" if r["svd_error"] == 0.0 else f"{r['svd_error']:.1e}"
        cells = [r["what"], f"{r['count']:,}", "{} x {}".format(*r["shape"]), f"{r['least']:.1e}"]
        cells += [f"{r['qr_error']:.1e}", f"{r['qr_us']:.2f}", svd, f"{r['svd_us']:.2f}"]
        cells += [
            f"{r['determinant_error']:.1e}",
            f"{r['determinant_failed']:,}",
            f"{r['determinant_us']:.2f}",
        ]
        lines.append(cells)
    head = "| configurations | J | smallest w | QR: error | time (us) | SVD: error | time (us) | det: error"
    return markdown(f"{head} | not a number | time (us)", lines)


TITLES = {
    "off": "none",
    "damped": "none; the policy damps its inverse",
    "speeds": "`JointSpeedLimit`",
    "margin": "`SingularityMargin`",
    "both": "both",
}


def path_table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = []
    for r in rows:
        filtered = r["mode"] not in ("off", "damped")
        where = (
            f"{r['arm']}, {r['kind']}: w > {r['threshold']:.3g}, limit {ARMS[r['arm']].rate_limit:g} rad/s"
        )
        cells = [where, TITLES[r["mode"]], f"{r['peak']:.2f}", f"{r['p999']:.2f}", f"{r['over']:.2%}"]
        cells += [f"{r['time_below']:.1%}", f"{r['unflagged']:,}" if r["mode"] in ("margin", "both") else "-"]
        cells += [f"{1e3 * r['error_rms']:.1f}", f"{1e3 * r['error_max']:.0f}"]
        infeasible = f"{r['infeasible']:,} of {r['steps']:,}"
        acted = [f"{r['changed'] / r['steps']:.1%}", infeasible, f"{r['filter_us']:,.0f}"]
        lines.append(cells + (acted if filtered else ["-"] * 3))
    head = "path | constraint | peak rate (rad/s) | 99.9 % | over the limit | time below threshold"
    more = "error, rms (mm) | largest | steps changed | infeasible | filter (us)"
    return markdown(f"{head} | steps below, unflagged | {more}", lines)


def attack_table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = []
    on = {(r["arm"], r["driver"]): r for r in rows if r["filtered"]}
    for r in (r for r in rows if not r["filtered"]):
        with_ = on.get((r["arm"], r["driver"]))
        if with_ is None:
            continue
        n = with_["steps"]
        cells = [
            r["arm"],
            r["driver"],
            f"{n:,}",
            f"{r['below'] / r['steps']:.1%}",
            f"{with_['below'] / n:.1%}",
        ]
        cells += [f"{with_['unsafe'] / n:.1%}", f"{with_['unflagged']:,}", f"{with_['least']:.4f}"]
        cells += [f"{with_['changed'] / n:.1%}", f"{with_['infeasible']:,}", f"{with_['filter_us']:,.0f}"]
        lines.append(cells)
    head = "arm | driver | steps | below, off | below, on | starting below | unflagged"
    more = "smallest w / threshold, once inside | changed | infeasible | filter (us)"
    return markdown(f"{head} | {more}", lines)


PARTS = ("measure", "paths", "attacks")


def main() -> None:
    """Run the parts, keep them, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--part", choices=PARTS, default=None, help="one of them only")
    parser.add_argument("--paths", type=int, default=20, help="of each kind")
    parser.add_argument("--steps", type=int, default=2500, help="of each driver on each arm")
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    arguments = parser.parse_args()
    kept = RESULTS / "singularity.json"
    results: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
    wanted = PARTS if arguments.part is None else (arguments.part,)
    if "measure" in wanted:
        results["measure"] = measure(10_000)
    attacks = [AttackJob(a, d, f, arguments.steps) for a in ARMS for d in DRIVERS for f in (False, True)]
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        if "paths" in wanted:
            results["paths"] = pool.map(partial(on_cpu_time, follow), path_jobs(arguments.paths), chunksize=1)
        if "attacks" in wanted:
            results["attacks"] = pool.map(partial(on_cpu_time, attack), attacks, chunksize=1)
    tables = {"measure": measure_table, "paths": path_table, "attacks": attack_table}
    text = "\n\n".join(tables[part](results[part]) for part in PARTS if part in results)
    keep(RESULTS, "singularity", results, text)


if __name__ == "__main__":
    main()
