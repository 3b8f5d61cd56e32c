"""Golden traces: what every protected env did, step by step, before a change, compared with today.

    python -m benchmarks golden_traces                    # bit for bit: all runs of tests/data/golden_traces.json
    python -m benchmarks golden_traces --behaviour        # what the filter did in each run, within a tolerance
    python -m benchmarks golden_traces --envs Reacher     # of the envs whose name has one of these words
    python -m benchmarks golden_traces --short            # three envs, one seed: the default tests
    python -m benchmarks golden_traces --write            # records what is compared from now on

Each env runs under a random and an attacking driver, two seeds, 500 control steps each. Recorded are observation,
reward, end of episode, executed action and every number in `info`: not themselves but chained digests of 50 steps
each, so that a difference is found by field and by place and the file stays small.

Bits depend on the processor's vector instructions and on the versions of the libraries. The command therefore runs
with those instructions that every x86-64 processor of the last ten years has, and records versions and a probe of
the arithmetic; where they are others than recorded, nothing is compared, and it says so (exit status 3).

Behaviour is for changes of numerics, after which no bit stays: of each run the shares of changed, infeasible,
fallback and unsafe steps, the violations by the env's judge, the mean correction and the return. A run behaves as
before where each of them is within `TOLERANCES` (relative, absolute) plus the difference between the recorded runs
of the same driver with other seeds, which is what chance alone changes. What is beyond is listed.
"""

import hashlib
import importlib.metadata
import json
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import mujoco_drivers as drivers
from benchmarks.cases import CASES, PROTECTED, Case
from benchmarks.judges import Reported
from benchmarks.mujoco_drivers import Maker
from benchmarks.tables import CORES, made, options
from safe_wrappers.envs.teleop_contact import (
    CLAMP_Y,
    TELEOP_ACCELERATION,
    TELEOP_BRAKING,
    TELEOP_TOP_SPEED,
    TOOL_RADIUS,
)
from safe_wrappers.wrappers.faults import Outages, RepeatedCommands

RECORDED = Path(__file__).parents[1] / "tests" / "data" / "golden_traces.json"
STEPS, SEEDS, PER_DIGEST = 500, (0, 1), 50
SHORT = ("SafePointGoal1-v0", "Reacher-v5", "Hopper, all contacts")
"""What the default tests compare: a closed form, forecasts, and both with monitors around them."""
SAME_BITS = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OMP_NUM_THREADS": "1",
}
"""The environment in which the command runs itself."""
NOT_COMPARABLE = 3
TOLERANCES = {
    "changed": (0.05, 0.01),
    "infeasible": (0.1, 0.004),
    "fallback": (0.1, 0.004),
    "unsafe": (0.1, 0.004),
    "violations": (0.0, 0.0),
    "correction": (0.05, 0.005),
    "return": (0.1, 0.5),
}
"""By figure: relative and absolute. Figures are per step, the correction (action units) is over all steps."""

_ATTACKING = {
    "SafeCarGoal1-v0": "full throttle",
    "SafeCarGoal2-v0": "vase-seeking",
}
"""The drivers that the filter answers most often, where they are not the last ones of their case."""

Make = Callable[[], gym.Env[Any, Any]]


def _late_commands(env_id: str, constraint: sw.Constraint, rate_limit: float, **bounds: float) -> Make:
    """Faults around a handover around a lease around a filter."""

    def make() -> gym.Env[Any, Any]:
        env: Any = sw.CBFActionFilter(gym.make(env_id), [constraint])
        env = sw.RecordInterventions(
            sw.LeaseExpiry(env, sw.StoppingBudget(constraint, **bounds), max_lease_s=0.15)
        )
        env = sw.ChunkHandover(env, 6, 3, [0, 2], rate_limit=rate_limit)
        return RepeatedCommands(Outages(env, 0.5, 0.2), 0.2)

    return make


def _hopper() -> gym.Env[Any, Any]:
    env = sw.WholeBodyFilter(gym.make("Hopper-v5"), friction_share=0.6, zmp_inset=0.02)
    return sw.BalanceMonitor(sw.ContactMonitor(env))


def _teleop() -> gym.Env[Any, Any]:
    link = sw.teleop.Link(delay_s=0.02, jitter_s=0.004, loss=0.05)
    clamp = sw.constraints.Clearance(
        [sw.constraints.Plane([0.0, CLAMP_Y], [0.0, -1.0])],
        TELEOP_BRAKING,
        bodies=["tool"],
        radius=TOOL_RADIUS,
    )
    budget = sw.StoppingBudget(clamp, acceleration=TELEOP_ACCELERATION, top_speed=TELEOP_TOP_SPEED)
    return sw.TeleopChannel(gym.make("TeleopContact-v0"), link, link, impedance=40.0, budget=budget)


def _lease_alone() -> gym.Env[Any, Any]:
    rail = sw.constraints.Clearance(
        [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])], bodies=["cart"], braking=8.0
    )
    env = sw.LeaseExpiry(
        gym.make("InvertedPendulum-v5"), sw.StoppingBudget(rail, acceleration=20.0), max_lease_s=0.12
    )
    return Outages(sw.RecordInterventions(env), 0.12, 0.3)


_POINT = sw.constraints.HeadingDriveClearance(
    [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.004
)
_STACKS: dict[str, Make] = {
    "SafePointGoal1, late commands": _late_commands("SafePointGoal1-v0", _POINT, 40.0, closing_speed=4.0),
    "Reacher, late commands": _late_commands(
        "Reacher-v5",
        sw.constraints.JointPositionLimit(-1.5, 1.5, ["joint1"]),
        40.0,
        closing_speed=10.0,
    ),
    "InvertedPendulum, a lease alone": _lease_alone,
    "Hopper, all contacts": _hopper,
    "Hopper, stance": lambda: sw.CBFActionFilter(
        gym.make("Hopper-v5"), [sw.constraints.Stance(cone="exact")]
    ),
    "TeleopContact, over a network": _teleop,
}


def runs() -> dict[str, tuple[Make, dict[str, Maker], Case | None]]:
    """By name: how to make the env, its two drivers, and the case whose judge it has."""
    found: dict[str, tuple[Make, dict[str, Maker], Case | None]] = {}
    for name, case in PROTECTED.items():
        attacking = _ATTACKING.get(name, list(case.drivers)[-1])
        pair = {"random": case.drivers["random"], attacking: case.drivers[attacking]}
        found[name] = (lambda case=case: case.protect(case.make()), pair, case)  # type: ignore[misc]
    disc = CASES["Reacher-v5, with a disc"]
    attack = {d: disc.drivers[d] for d in ("random", "disc-seeking")}
    found[disc.name] = (lambda: disc.protect(disc.make()), attack, disc)
    for name, make in _STACKS.items():
        pulse = CASES["SafePointGoal1-v0"].drivers["bang-bang"] if "PointGoal" in name else drivers.pulse
        found[name] = (make, {"random": drivers.random, "pulse": pulse}, None)
    return found


def trace(make: Make, driver: Maker, seed: int, case: Case | None = None) -> dict[str, Any]:
    """One run: what the filter did, as `behaviour`, and the digests by field.

    Violations are None where nobody judges: in stacks that execute several control steps at once.
    """
    env = make()
    judge = Reported(lambda info: -np.inf) if case is None else case.judge(env.unwrapped)
    rng = np.random.default_rng(seed)
    # A chunk is asked of the driver command by command.
    commands = int(math.prod(env.action_space.shape or ())) // int(
        math.prod(env.unwrapped.action_space.shape or ())
    )
    act = driver(env.unwrapped, rng)
    digests: dict[str, Any] = {}
    lines: dict[str, list[str]] = {}
    sums = dict.fromkeys(TOLERANCES, 0.0)
    observation, info = env.reset(seed=seed)
    judge.start()
    episode = seed * 1_000
    for step in range(STEPS):
        row = np.concatenate([np.asarray(act()) for _ in range(commands)])
        action = row.astype(env.action_space.dtype).reshape(env.action_space.shape)
        judge.before()
        observation, reward, terminated, truncated, info = env.step(action)
        sums["violations"] += not judge.after(info.get("executed_action", action), info) <= 0.0
        sums["changed"] += int(np.any(info.get("cbf/intervened", False)))
        for name in ("infeasible", "fallback", "unsafe"):
            sums[name] += int(np.any(info.get(f"cbf/{name}", False)))
        sums["correction"] += float(np.max(info.get("cbf/correction", 0.0)))
        sums["return"] += float(reward)
        now = {"observation": observation, "reward": reward, "over": [terminated, truncated], "info": info}
        for field, value in _numbers("", now):
            digest = digests.setdefault(field, hashlib.blake2b(digest_size=4))
            digest.update(f"{step} {value.dtype} {value.shape}".encode() + value.tobytes())
        if (step + 1) % PER_DIGEST == 0:
            for field, digest in digests.items():
                lines.setdefault(field, []).append(digest.hexdigest())
        if terminated or truncated:
            episode += 1
            env.reset(seed=episode)
    env.close()
    behaviour: dict[str, float | None] = {name: round(total / STEPS, 6) for name, total in sums.items()}
    if case is None:
        behaviour["violations"] = None
    digests_by_field = {field: " ".join(found) for field, found in sorted(lines.items())}
    return {"behaviour": behaviour, "digests": digests_by_field}


def _numbers(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """The numbers of a nested value, by field."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _numbers(f"{name} {key}".strip(), part)
        return
    array = np.asarray(value)
    if array.dtype.kind in "biuf":
        yield name, np.ascontiguousarray(array)


def _job(job: tuple[str, str, int]) -> tuple[str, dict[str, Any]]:
    warnings.simplefilter("ignore")
    name, driver, seed = job
    make, by_name, case = runs()[name]
    return f"{name}; {driver}; seed {seed}", trace(make, by_name[driver], seed, case)


def arithmetic() -> dict[str, str]:
    """What decides about the last bits: the libraries' versions, and a probe of what they compute."""
    libraries = (
        "numpy",
        "scipy",
        "mujoco",
        "gymnasium",
        "gymnasium-robotics",
        "qpsolvers",
        "daqp",
        "clarabel",
    )
    rng = np.random.default_rng(0)
    a, x = rng.normal(size=(24, 24)), rng.normal(size=1001)
    parts = [a @ a, np.linalg.solve(a, x[:24]), np.linalg.svd(a)[1], np.linalg.eigvalsh(a + a.T), a @ x[:24]]
    parts += [f(x) for f in (np.sin, np.exp, np.arctan, np.sum, np.tanh)] + [np.hypot(x, 2.0), x @ x]
    parts += [np.array([f(v) for v in x]) for f in (math.sin, math.cos, math.exp, math.atan)]
    digest = hashlib.blake2b(b"".join(np.ascontiguousarray(p).tobytes() for p in parts), digest_size=8)
    versions = {name: importlib.metadata.version(name) for name in libraries}
    return versions | {"probe": digest.hexdigest()}


def differences(recorded: Mapping[str, Any], today: Mapping[str, Any]) -> list[str]:
    """Where the runs of today are not the recorded ones, in words; runs that were not made are left out."""
    found = []
    for run, now in today.items():
        before = recorded.get(run)
        if before is None:
            found.append(f"{run}: was not recorded")
            continue
        for field in sorted(before["digests"].keys() | now["digests"].keys()):
            old, new = (of["digests"].get(field, "").split() for of in (before, now))
            if old == new:
                continue
            if not (old and new):
                found.append(f"{run}: {field} {'is gone' if old else 'is new'}")
                continue
            first = next((i for i, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1]), 0)
            found.append(
                f"{run}: {field} differs from steps {first * PER_DIGEST} to {(first + 1) * PER_DIGEST} on"
            )
    return found


def misbehaviour(recorded: Mapping[str, Any], today: Mapping[str, Any]) -> list[str]:
    """Where a run of today is beyond the tolerance of what was recorded, in words."""
    found = []
    for run, now in today.items():
        if run not in recorded:
            found.append(f"{run}: was not recorded")
            continue
        before = recorded[run]["behaviour"]
        driver = run.rsplit("; ", 1)[0]
        seeds = [other["behaviour"] for name, other in recorded.items() if name.startswith(f"{driver}; ")]
        for figure, (relative, absolute) in TOLERANCES.items():
            old, new = before[figure], now["behaviour"][figure]
            if old is None or new is None:
                if old != new:
                    found.append(f"{run}: {figure} was {old}, is {new}")
                continue
            spread = max(abs(other[figure] - old) for other in seeds)
            if abs(new - old) > relative * abs(old) + absolute + spread:
                found.append(f"{run}: {figure} was {old:.4g}, is {new:.4g}")
    return found


def main() -> None:
    given = options(__doc__, write=False, behaviour=False, short=False, envs=[], workers=CORES)
    if any(os.environ.get(name) != value for name, value in SAME_BITS.items()):
        words = [sys.executable, "-W", "ignore", "-m", "benchmarks", "golden_traces", *sys.argv[1:]]
        sys.exit(subprocess.run(words, env=os.environ | SAME_BITS).returncode)
    chosen = [
        name
        for name in runs()
        if (not given.short or name in SHORT) and (not given.envs or any(word in name for word in given.envs))
    ]
    if not chosen:
        raise SystemExit(f"no env has one of these words; there are: {'; '.join(runs())}")
    kept = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    here = arithmetic()
    if not (given.write or given.behaviour) and kept.get("arithmetic") != here:
        print(f"not comparable: recorded with {kept.get('arithmetic')}, this is {here}")
        sys.exit(NOT_COMPARABLE)
    seeds = SEEDS[: 1 if given.short else None]
    jobs = [(name, driver, seed) for name in chosen for driver in runs()[name][1] for seed in seeds]
    today: dict[str, Any] = {}
    for run, found in made(_job, jobs, given.workers):
        today[run] = found
        if sys.stderr.isatty():
            print(f"{len(today)} of {len(jobs)}: {run}", file=sys.stderr)
    if given.write:
        same = kept.get("arithmetic") == here
        whole = len(chosen) == len(runs())
        runs_kept = (kept.get("runs", {}) if same and not whole else {}) | today
        text = json.dumps({"arithmetic": here, "runs": dict(sorted(runs_kept.items()))}, indent=1)
        RECORDED.write_text(text + "\n")
        print(f"{len(today)} runs of {STEPS} steps recorded in {RECORDED}")
        return
    if given.behaviour:
        found, equal = misbehaviour(kept["runs"], today), "behave as recorded, within the tolerance"
    else:
        found, equal = differences(kept["runs"], today), "are equal bit for bit"
    print("\n".join(found) if found else f"{len(today)} runs of {STEPS} steps {equal}")
    sys.exit(1 if found else 0)
