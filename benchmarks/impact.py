"""Approaches of an arm to a wall that is a spring, with `ImpactSpeedLimit` and without: who exceeds the force limit.

    python -m benchmarks impact    # 2 x 10,000 approaches, half an hour; goes on where it was stopped

Reacher's arm, a wall of random place, stiffness and force limit, a payload; 0.4 s each. Drivers: random torques, full
torque at the wall, the corner of the action space that presses most, feints (away, then at it), and the corner that a
forecast on the true model finds worst. The same approaches with the constraint and without; judged by the largest
normal force of any physics substep. The filter keeps 2 % of the limit as its margin.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks.tables import CORES, RUNS, keep, markdown, measured, options, total

TIMESTEP_S, SUBSTEPS = 0.002, 10
"""A control step of 20 ms, as Reacher's."""
IMPEDANCE = 0.001
REACH_M, TIP_M = 0.21, 0.01
"""Base to the fingertip's centre, and its radius."""
MARGIN = 0.02
"""Share of the force limit."""
STEPS = 20
"""Control steps of an approach."""
BLOCK, MACHINES = 100, 4
"""Approaches of a job, and the walls that they go to."""
DRIVERS = ("random", "push", "corner", "feint", "worst")
_REACHER = Path(gym.__file__).parent / "envs" / "mujoco" / "assets" / "reacher.xml"


def arm_model(stiffness: float, payload: float) -> mujoco.MjModel:
    """Reacher with a wall ("wall", a mocap body) that its fingertip alone can touch, a spring without damping.

    MuJoCo's contact forces are k x with k = |solref[0]| / diagApprox where the impedance is near 0; diagApprox is the
    touching body's `body_invweight0` in the pose of reference, whatever the pose.

    Args:
        stiffness: Of the wall, N/m.
        payload: Added to the fingertip, kg.
    """
    spec = mujoco.MjSpec.from_file(str(_REACHER))
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for geom in spec.geoms:
        geom.conaffinity, geom.condim = int(geom.name == "fingertip"), 1
    no_contact: dict[str, Any] = {"contype": 0, "conaffinity": 0}
    sphere, box = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX
    spec.body("fingertip").add_geom(
        name="payload", type=sphere, size=[0.005, 0, 0], mass=payload, **no_contact
    )
    wall = spec.worldbody.add_body(name="wall", mocap=True, pos=[1.0, 0.0, 0.01])
    wall.add_geom(name="wall", type=box, size=[0.2, 1.0, 0.2], contype=1, conaffinity=0, condim=1)
    model = spec.compile()
    index = model.geom("wall").id
    model.geom_priority[index] = 1
    model.geom_solref[index] = -stiffness * model.body("fingertip").invweight0[0], 0.0
    model.geom_solimp[index] = IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0
    return model


def normal_force(data: mujoco.MjData) -> float:
    """Of all contacts together, N: of a frictionless one the constraint's force is the normal force."""
    return float(data.efc_force[data.contact.efc_address[: data.ncon]].sum()) if data.ncon else 0.0


class ArmAndWall(gym.Env[np.ndarray, np.ndarray]):
    """The arm, torques as actions.

    `reset(options=...)` takes "qpos", "qvel" (2,), and the wall's "angle" and "distance": it is a plane at a distance
    (m) from the base, seen in a direction (rad).

    Attributes:
        forces: Normal forces of the last control step, shape (substeps,), N.
    """

    def __init__(self, stiffness: float, payload: float) -> None:
        self.model = arm_model(stiffness, payload)
        self.data = mujoco.MjData(self.model)
        self.frame_skip, self.dt = SUBSTEPS, SUBSTEPS * TIMESTEP_S
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.forces = np.zeros(SUBSTEPS)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """The approach of the options."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        given: dict[str, Any] = options or {}
        self.data.qpos[:2], self.data.qvel[:2] = given["qpos"], given["qvel"]
        angle, distance = given["angle"], given["distance"]
        self.normal = np.array([np.cos(angle), np.sin(angle), 0.0])
        self.data.mocap_pos[0] = (distance + 0.2) * self.normal + [0.0, 0.0, 0.01]
        self.data.mocap_quat[0] = np.cos(angle / 2.0), 0.0, 0.0, np.sin(angle / 2.0)
        self.forces[:] = 0.0
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold the torques for a control step."""
        self.data.ctrl[:] = action
        for i in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
            self.forces[i] = normal_force(self.data)
        return self._observation(), 0.0, False, False, {}

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.data.qpos[:2], self.data.qvel[:2]])


def approached(rng: np.random.Generator) -> dict[str, Any]:
    """A pose before a wall; farther away than 50 mm it may move already."""
    while True:
        qpos, angle = rng.uniform(-2.5, 2.5, 2), float(rng.uniform(-np.pi, np.pi))
        distance = float(rng.uniform(0.125, 0.205))
        tip = 0.1 * np.cos(qpos[0] - angle) + (REACH_M - 0.1) * np.cos(qpos.sum() - angle)
        gap = distance - TIP_M - tip
        if 0.005 < gap < 0.15:
            qvel = rng.uniform(-3.0, 3.0, 2) if gap > 0.05 else np.zeros(2)
            return {"qpos": qpos, "qvel": qvel, "angle": angle, "distance": distance}


def actions(name: str, raw: ArmAndWall, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """What attacks the wall: one of `DRIVERS`, step by step."""
    data, jacobian = mujoco.MjData(raw.model), np.zeros((3, raw.model.nv))
    tip, corners = raw.model.geom("fingertip").id, np.array([*itertools.product((-1.0, 1.0), repeat=2)])
    directions = itertools.cycle((-1.0, 1.0) if name == "feint" else (1.0,))

    def harm(action: np.ndarray) -> float:
        """How hard an action held for two control steps hits, or how fast it comes near."""
        mujoco.mj_copyData(data, raw.model, raw.data)
        data.ctrl[:] = action
        force = 0.0
        for _ in range(2 * SUBSTEPS):
            mujoco.mj_step(raw.model, data)
            force = max(force, normal_force(data))
        return 1e3 * force + float(data.geom_xpos[tip] @ raw.normal)

    while True:
        direction = next(directions)
        for _ in range(int(rng.integers(1, 6)) if name == "feint" else 1):
            mujoco.mj_jacGeom(raw.model, raw.data, jacobian, None, tip)
            effect = (jacobian.T @ raw.normal)[:2]
            if name == "random":
                yield rng.uniform(-1.0, 1.0, 2)
            elif name == "worst":
                yield max(corners, key=harm)
            elif name == "corner":
                yield np.where(effect < 0.0, -1.0, 1.0)
            else:
                yield direction * effect / max(float(np.abs(effect).max()), 1e-9)


class Job(NamedTuple):
    """A block of approaches."""

    limited: bool
    block: int


def run(job: Job) -> dict[str, Any]:
    """A block, summed up; the same approaches with the constraint and without."""
    shares: list[float] = []
    counts = dict.fromkeys(("steps", "changed", "infeasible", "touched", "exceeded"), 0)
    for first in range(0, BLOCK, BLOCK // MACHINES):
        rng = np.random.default_rng((job.block, first))
        # Stiffness and limits of the range of ISO/TS 15066's regions.
        stiffness = float(np.exp(rng.uniform(np.log(1e4), np.log(75e3))))
        limit, payload = float(rng.uniform(100.0, 440.0)), float(rng.uniform(0.0, 2.0))
        raw = ArmAndWall(stiffness, payload)
        env: Any = raw
        if job.limited:
            kept = {"force_limit": limit, "stiffness": stiffness, "margin": MARGIN * limit, "horizon": 6}
            env = sw.CBFActionFilter(raw, [sw.constraints.ImpactSpeedLimit(["fingertip"], ["wall"], **kept)])
        for k in range(first, first + BLOCK // MACHINES):
            rng = np.random.default_rng((job.block, first, k))
            driver, peak = actions(DRIVERS[k % len(DRIVERS)], raw, rng), 0.0
            env.reset(seed=0, options=approached(rng))
            for _ in range(STEPS):
                info = env.step(next(driver).astype(np.float32))[4]
                peak = max(peak, float(raw.forces.max()))
                counts["steps"] += 1
                counts["changed"] += bool(info.get("cbf/intervened"))
                counts["infeasible"] += bool(info.get("cbf/infeasible") or info.get("cbf/fallback"))
            counts["touched"] += peak > 0.0
            counts["exceeded"] += peak > limit
            shares.append(peak / limit)
    return job._asdict() | counts | {"approaches": BLOCK, "share_sum": sum(shares), "share_max": max(shares)}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: without the constraint and with it."""
    lines = []
    for limited in (False, True):
        part = [row for row in rows if row["limited"] is limited]
        count, steps, exceeded = (total(part, key) for key in ("approaches", "steps", "exceeded"))
        cells = ["on" if limited else "off", f"{count:,}", f"{total(part, 'touched') / count:.1%}"]
        cells += [f"{exceeded:,} ({exceeded / count:.2%})", f"{max(row['share_max'] for row in part):.3f}"]
        cells.append(f"{sum(row['share_sum'] for row in part) / count:.3f}")
        acted = [f"{total(part, 'changed') / steps:.1%}", f"{total(part, 'infeasible'):,} of {steps:,}"]
        lines.append([*cells, *(acted if limited else ["-", "-"])])
    head = " | approaches | touched | over the limit | largest force / limit | mean | steps changed"
    return markdown(f"{head} | infeasible", lines)


def main() -> None:
    """Run what is missing, print the table."""
    given = options(__doc__, approaches=10_000, workers=CORES)
    jobs = [Job(limited, block) for block in range(given.approaches // BLOCK) for limited in (False, True)]
    keep("impact", table(measured(RUNS / "impact/impact.jsonl", jobs, run, given.workers)))
