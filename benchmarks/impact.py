"""Impacts: MuJoCo's peak contact force against the formula, and 10,000 approaches of an arm to a wall.

    python -m benchmarks.impact    # the tables, then 2 x 10,000 approaches; goes on where it was stopped

Peak force. A mass on a slide runs into a wall that is a spring (`benchmarks.arm_and_wall.springy`), over a grid of
masses, stiffnesses and speeds, at several physics steps; measured is the largest normal force of MuJoCo's contact.
The formula is `v sqrt(k m)`. An integration of the differential equation by scipy stands beside it. Then Reacher's
arm runs into the wall unpowered, in random poses: there the formula's mass is the effective mass at the first touch,
and what it leaves out (damping in the joints, and a pose that changes during the contact) shows.

Approaches. Reacher's arm, a wall of random place, stiffness and force limit, a payload; 0.4 s each. Drivers: random
torques, full torque at the wall, the corner of the action space that presses most, feints (away, then at it), and the
corner that a forecast on the true model finds worst. The same approaches with `ImpactSpeedLimit` and without; judged
by the largest normal force of any physics substep. The filter keeps 2 % of the limit as its margin.
"""

import argparse
import json
import multiprocessing
import time
from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.integrate import solve_ivp

import safe_wrappers as sw
from benchmarks.arm_and_wall import REACH_M, SUBSTEPS, TIP_M, ArmAndWall, arm_model, normal_force, springy
from benchmarks.tables import RESULTS, markdown
from safe_wrappers.control.contact.impact import peak_force

MASSES = (0.5, 2.0, 10.0, 40.0)
STIFFNESSES = (5e3, 25e3, 75e3, 150e3)
SPEEDS = (0.1, 0.3, 1.0)
TIMESTEPS = (2e-3, 1e-3, 5e-4, 1e-4, 2e-5)
MARGIN = 0.02
"""Share of the force limit."""
STEPS = 20
"""Control steps of an approach."""
BLOCK = 100
"""Approaches per row of the results; 25 with each machine."""
MACHINES = 4

# The formula --------------------------------------------------------------------------------------------------


def measured_peak(mass: float, stiffness: float, speed: float, timestep: float, phase: float = 0.5) -> float:
    """The largest normal force when a mass on a slide meets the wall, N.

    Args:
        mass: kg.
        stiffness: N/m.
        speed: m/s.
        timestep: Of the physics, s.
        phase: Where in a physics step the first touch falls, 0 to 1.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = timestep, [0.0, 0.0, 0.0]
    wall = spec.worldbody.add_body(name="wall", pos=[1.0, 0.0, 0.0])
    wall.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5, 1.0, 1.0], condim=1)
    body = spec.worldbody.add_body(name="mass")
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1.0, 0.0, 0.0])
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0.0, 0.0], mass=mass, condim=1)
    model = spec.compile()
    springy(model, "wall", "mass", stiffness)
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = 0.4 - (1.0 + phase) * speed * timestep, speed
    peak = 0.0
    while data.qvel[0] > 0.0:
        mujoco.mj_step(model, data)
        peak = max(peak, normal_force(data))
    return peak


def integrated_peak(mass: float, stiffness: float, speed: float) -> float:
    """The same by scipy's integration of `m x'' = -k x`, N."""

    def turned(_: float, state: np.ndarray) -> float:
        return float(state[1])

    turned.terminal = True  # type: ignore[attr-defined]
    longest = 4.0 * np.sqrt(mass / stiffness)
    done = solve_ivp(
        lambda _, s: [s[1], -stiffness / mass * s[0]],
        (0.0, longest),
        [0.0, speed],
        events=turned,
        rtol=1e-10,
        atol=1e-14,
    )
    return float(stiffness * done.y_events[0][0][0])


def grid(timestep: float, seed: int = 0) -> dict[str, Any]:
    """Errors of MuJoCo's peak against the formula over the whole grid, each touch at a random phase of a step."""
    rng = np.random.default_rng(seed)
    errors = []
    for mass in MASSES:
        for stiffness in STIFFNESSES:
            for speed in SPEEDS:
                expected = float(peak_force(speed, mass, stiffness))
                errors.append(
                    measured_peak(mass, stiffness, speed, timestep, float(rng.random())) / expected - 1.0
                )
    size = np.abs(errors)
    return {
        "timestep": timestep,
        "cases": len(errors),
        "mean": float(size.mean()),
        "worst": float(size.max()),
    }


def oracle() -> float:
    """The largest relative difference of the formula from the integration, over the grid."""
    worst = 0.0
    for mass in MASSES:
        for stiffness in STIFFNESSES:
            for speed in SPEEDS:
                expected = float(peak_force(speed, mass, stiffness))
                worst = max(worst, abs(integrated_peak(mass, stiffness, speed) / expected - 1.0))
    return worst


def unpowered(hits: int, seed: int = 0, timestep: float = 1e-4) -> dict[str, Any]:
    """Reacher's arm, torques off, into the wall: measured peak over the formula's for the mass at first touch.

    "square" are the hits whose direction is within 30 degrees of the wall's normal: the others slide along it.
    """
    rng = np.random.default_rng((seed, 1))
    ratios, square = [], []
    while len(ratios) < hits:
        stiffness = float(np.exp(rng.uniform(np.log(1e4), np.log(75e3))))
        model = arm_model(stiffness, timestep=timestep)
        data = mujoco.MjData(model)
        tip, jacobian = model.geom("fingertip").id, np.zeros((3, model.nv))
        for _ in range(20):
            mujoco.mj_resetData(model, data)
            data.qpos[:2], data.qvel[:2] = rng.uniform(-2.5, 2.5, 2), rng.uniform(-6.0, 6.0, 2)
            mujoco.mj_forward(model, data)
            mujoco.mj_jacGeom(model, data, jacobian, None, tip)
            x, row = float(data.geom_xpos[tip, 0]), jacobian[0, :2].copy()
            speed, aside = float(row @ data.qvel[:2]), abs(float(jacobian[1] @ data.qvel))
            if speed < 0.05 or x < 0.125:
                continue
            mass = 1.0 / float(row @ np.linalg.solve(inertia(model, data)[:2, :2], row))
            data.mocap_pos[0] = x + TIP_M + 0.2, 0.0, 0.01
            peak, longest = 0.0, int(4.0 * np.sqrt(mass / stiffness) / timestep)
            for _ in range(longest):
                mujoco.mj_step(model, data)
                force = normal_force(data)
                if force <= 0.0 < peak:
                    break
                peak = max(peak, force)
            ratios.append(peak / float(peak_force(speed, mass, stiffness)) - 1.0)
            square.append(aside < np.tan(np.pi / 6.0) * speed)
            if len(ratios) == hits:
                break
    errors = np.array(ratios)
    return {"all": _spread(errors), "square": _spread(errors[np.array(square)])}


def _spread(errors: np.ndarray) -> dict[str, Any]:
    return {
        "hits": errors.size,
        "mean": float(np.abs(errors).mean()),
        "highest": float(errors.max()),
        "lowest": float(errors.min()),
    }


def inertia(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """The joint-space inertia of a state, shape (nv, nv)."""
    whole = np.empty((model.nv, model.nv))
    for column, unit in zip(whole, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return whole


# Approaches ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Machine:
    """A wall, a limit and a payload.

    Attributes:
        stiffness: N/m.
        force: Limit, N.
        payload: kg.
    """

    stiffness: float
    force: float
    payload: float


def machine(rng: np.random.Generator) -> Machine:
    """Stiffness and limits of the range of ISO/TS 15066's regions."""
    return Machine(
        stiffness=float(np.exp(rng.uniform(np.log(1e4), np.log(75e3)))),
        force=float(rng.uniform(100.0, 440.0)),
        payload=float(rng.uniform(0.0, 2.0)),
    )


def env_of(kind: Machine, limited: bool) -> Any:
    """The arm, with the constraint or without."""
    env = ArmAndWall(kind.stiffness, kind.payload)
    if not limited:
        return env
    limit = sw.constraints.ImpactSpeedLimit(
        ["fingertip"],
        ["wall"],
        force_limit=kind.force,
        stiffness=kind.stiffness,
        margin=MARGIN * kind.force,
        horizon=6,
    )
    return sw.CBFActionFilter(env, [limit])


def start(rng: np.random.Generator) -> dict[str, Any]:
    """A pose before a wall; farther away than 50 mm it may move already."""
    while True:
        qpos, angle = rng.uniform(-2.5, 2.5, 2), float(rng.uniform(-np.pi, np.pi))
        distance = float(rng.uniform(0.125, 0.205))
        tip = 0.1 * np.cos(qpos[0] - angle) + (REACH_M - 0.1) * np.cos(qpos.sum() - angle)
        gap = distance - TIP_M - tip
        if 0.005 < gap < 0.15:
            qvel = rng.uniform(-3.0, 3.0, 2) if gap > 0.05 else np.zeros(2)
            return {"qpos": qpos, "qvel": qvel, "angle": angle, "distance": distance}


def pressing(raw: ArmAndWall) -> np.ndarray:
    """The torques' effect on the fingertip's force at the wall, shape (2,)."""
    jacobian = np.zeros((3, raw.model.nv))
    mujoco.mj_jacGeom(raw.model, raw.data, jacobian, None, raw.model.geom("fingertip").id)
    return np.asarray((jacobian.T @ raw.normal)[:2])


class Driver:
    """What attacks the wall: one of `DRIVERS`, seeded."""

    def __init__(self, name: str, raw: ArmAndWall, rng: np.random.Generator) -> None:
        self._name, self._raw, self._rng, self._left, self._away = name, raw, rng, 0, False
        self._data = mujoco.MjData(raw.model)

    def act(self) -> np.ndarray:
        """The next action, shape (2,)."""
        rng, raw = self._rng, self._raw
        if self._name == "random":
            return rng.uniform(-1.0, 1.0, 2)
        effect = pressing(raw)
        push = effect / max(float(np.abs(effect).max()), 1e-9)
        if self._name == "push":
            return push
        if self._name == "corner":
            return np.where(effect < 0.0, -1.0, 1.0)
        if self._name == "feint":
            if self._left == 0:
                self._left, self._away = int(rng.integers(1, 6)), not self._away
            self._left -= 1
            return -push if self._away else push
        corners = [np.array([a, b]) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
        return max(corners, key=self._harm)

    def _harm(self, action: np.ndarray) -> float:
        """How hard an action held for two control steps hits, or how fast it comes near."""
        raw, data = self._raw, self._data
        mujoco.mj_copyData(data, raw.model, raw.data)
        data.ctrl[:] = action
        force = 0.0
        for _ in range(2 * SUBSTEPS):
            mujoco.mj_step(raw.model, data)
            force = max(force, normal_force(data))
        near = float(data.geom_xpos[raw.model.geom("fingertip").id] @ raw.normal)
        return 1e3 * force + near


DRIVERS = ("random", "push", "corner", "feint", "worst")


@dataclass(frozen=True)
class Job:
    """A block of approaches."""

    limited: bool
    block: int
    approaches: int = BLOCK


def run(job: Job) -> dict[str, Any]:
    """A block, summed up; the same approaches with the constraint and without."""
    shares: list[float] = []
    counts = dict.fromkeys(("steps", "changed", "infeasible", "touched", "exceeded", "reported"), 0)
    worst: dict[str, Any] = {}
    each = -(-job.approaches // MACHINES)
    for first in range(0, job.approaches, each):
        kind = machine(np.random.default_rng((job.block, first)))
        env = env_of(kind, job.limited)
        raw: ArmAndWall = env.unwrapped
        for k in range(first, min(first + each, job.approaches)):
            rng = np.random.default_rng((job.block, first, k))
            driver = Driver(DRIVERS[k % len(DRIVERS)], raw, rng)
            env.reset(seed=0, options=start(rng))
            peak, flagged = 0.0, False
            for _ in range(STEPS):
                info = env.step(driver.act().astype(np.float32))[4]
                peak = max(peak, float(raw.forces.max()))
                counts["steps"] += 1
                counts["changed"] += bool(info.get("cbf/intervened", False))
                infeasible = bool(info.get("cbf/infeasible", False) or info.get("cbf/fallback", False))
                counts["infeasible"] += infeasible
                flagged |= infeasible
            share = peak / kind.force
            counts["touched"] += peak > 0.0
            counts["exceeded"] += share > 1.0
            counts["reported"] += share > 1.0 and flagged
            if share > max(shares, default=0.0):
                worst = {"share": share, "driver": DRIVERS[k % len(DRIVERS)], "index": k, **asdict(kind)}
            shares.append(share)
    return {
        "limited": job.limited,
        "block": job.block,
        "approaches": job.approaches,
        **counts,
        "share_sum": float(sum(shares)),
        "worst": worst,
    }


# Tables -------------------------------------------------------------------------------------------------------


def formula_table(found: dict[str, Any]) -> str:
    """Markdown: errors by physics step, then the arm."""
    steps = [
        (f"{1e3 * r['timestep']:g}", r["cases"], f"{r['mean']:.2%}", f"{r['worst']:.2%}")
        for r in found["grid"]
    ]
    titles = {"all": "any direction", "square": "within 30 degrees of the normal"}
    hits = [
        (titles[key], part["hits"], f"{part['mean']:.1%}", f"{part['lowest']:+.1%}, {part['highest']:+.2%}")
        for key, part in found["arm"].items()
    ]
    oracle = f"Formula against scipy's integration: {found['oracle']:.1e} at most."
    head = "Reacher's arm, unpowered | hits | mean error | smallest, largest peak against the formula"
    first = markdown("physics step (ms) | cases | mean error | worst error", steps)
    return "\n\n".join([first, oracle, markdown(head, hits)])


def approach_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: without the constraint and with it."""
    lines = []
    for limited, title in ((False, "off"), (True, "on")):
        part = [r for r in rows if r["limited"] is limited]
        if not part:
            continue

        def total(key: str, part: list[dict[str, Any]] = part) -> float:
            return float(sum(r[key] for r in part))

        count, steps = total("approaches"), total("steps")
        exceeded = f"{total('exceeded'):,.0f} ({total('exceeded') / count:.2%})"
        largest = f"{max(r['worst'].get('share', 0.0) for r in part):.3f}"
        acted = [f"{total('changed') / steps:.1%}", f"{total('infeasible'):,.0f} of {steps:,.0f}"]
        cells = [title, f"{count:,.0f}", f"{total('touched') / count:.1%}", exceeded, largest]
        lines.append([*cells, f"{total('share_sum') / count:.3f}", *(acted if limited else ["-", "-"])])
    return markdown(
        "| approaches | touched | over the limit | largest force / limit | mean | steps changed | infeasible",
        lines,
    )


def main() -> None:
    """Run what is missing, keep every block, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--approaches", type=int, default=10_000, help="per side, in blocks of 100")
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    arguments = parser.parse_args()
    RESULTS.mkdir(exist_ok=True)
    kept = RESULTS / "impact.json"
    results: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {"approaches": []}
    if "formula" not in results:
        results["formula"] = {
            "grid": [grid(t) for t in TIMESTEPS],
            "oracle": oracle(),
            "arm": unpowered(2000),
        }

    def keep() -> str:
        text = formula_table(results["formula"]) + "\n\n" + approach_table(results["approaches"])
        kept.write_text(json.dumps(results, indent=1) + "\n")
        (RESULTS / "impact.md").write_text(text + "\n")
        return text

    keep()
    done = {(r["limited"], r["block"]) for r in results["approaches"]}
    jobs = [Job(limited, b) for b in range(-(-arguments.approaches // BLOCK)) for limited in (False, True)]
    began = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        for row in pool.imap_unordered(run, [j for j in jobs if (j.limited, j.block) not in done]):
            results["approaches"].append(row)
            keep()
    print(keep())
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
