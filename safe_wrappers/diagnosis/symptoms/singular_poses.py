"""Singular poses: joint rates that peak where an arm loses a direction of its tip."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.constraints.limits.joints import driven_joints
from safe_wrappers.control.filtering.manipulability import manipulability
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, require_physics
from safe_wrappers.plants.mujoco.model import HINGE

NEAR = 0.2
"""Share of the largest manipulability below which a pose is near a singular one."""
LEAST_STEPS = 10
_SAMPLES = 500


def _arm(model: mujoco.MjModel) -> tuple[int, NDArray[np.int64]]:
    """The body at the tip of the longest chain of driven hinges on a fixed base, and their degrees of freedom."""
    driven = {j for j in driven_joints(model) if model.jnt_type[j] == HINGE}
    best: tuple[int, list[int]] = (0, [])
    for body in range(1, model.nbody):
        joints: list[int] = []
        at = body
        while at:
            first = int(model.body_jntadr[at])
            joints += range(first, first + int(model.body_jntnum[at]))
            at = int(model.body_parentid[at])
        if driven.issuperset(joints) and len(joints) >= max(2, len(best[1])):
            best = body, joints
    if not best[1]:
        raise NotMeasuredError("no chain of two or more driven hinges stands on a fixed base")
    return best[0], np.sort(model.jnt_dofadr[best[1]])


def _manipulability(
    model: mujoco.MjModel, tip: int, dofs: NDArray[np.int64], poses: Array
) -> tuple[Array, str]:
    """Of the tip's translation in the directions that the arm can move it, at poses of shape (k, nq); and these."""
    data, found = mujoco.MjData(model), np.zeros((len(poses), 3, len(dofs)))
    jacobian = np.zeros((3, model.nv))
    for k, qpos in enumerate(poses):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBody(model, data, jacobian, None, tip)
        found[k] = jacobian[:, dofs]
    moves = np.abs(found).max(axis=(0, 2)) > 1e-6
    directions = "".join(axis for axis, goes in zip("xyz", moves, strict=True) if goes)
    if not 0 < len(directions) <= len(dofs):
        raise NotMeasuredError(
            f"{len(dofs)} joints cannot move a tip in {len(directions)} directions at will"
        )
    return manipulability(found[:, moves]), directions


def _reach(model: mujoco.MjModel, tip: int, dofs: NDArray[np.int64]) -> tuple[float, str]:
    """The largest manipulability of poses at random, and the directions."""
    rng, joints = np.random.default_rng(0), model.dof_jntid[dofs]
    limited = model.jnt_limited[joints].astype(bool)
    low, high = np.where(limited[:, None], model.jnt_range[joints], [-np.pi, np.pi]).T
    poses = np.tile(model.qpos0, (_SAMPLES, 1))
    poses[:, model.jnt_qposadr[joints]] = rng.uniform(low, high, (_SAMPLES, len(joints)))
    found, directions = _manipulability(model, tip, dofs, poses)
    return float(found.max()), directions


def measure(env: Env, recording: Recording) -> Measured:
    """How many times as fast joints turn near singular poses as elsewhere (95th percentiles)."""
    model, _ = require_physics(env, "whose joints could be read")
    tip, dofs = _arm(model)
    largest, _ = _reach(model, tip, dofs)
    share = _manipulability(model, tip, dofs, recording.qpos)[0] / largest
    rates = np.abs(recording.qvel[:, dofs]).max(axis=1)
    near = share < NEAR
    evidence = [
        Evidence(
            f"lowest manipulability of {model.body(tip).name}, of the largest", float(share.min()), "share"
        ),
        Evidence("steps near a singular pose", float(near.mean()), "share"),
        Evidence("largest joint rate", float(rates.max()), "rad/s"),
    ]
    if (~near).sum() < LEAST_STEPS:
        raise NotMeasuredError(
            "the arm was near singular poses all the time, so that there is nothing to compare with"
        )
    if near.sum() < LEAST_STEPS:
        return Measured(0.0, rates, evidence)
    peaks = [float(np.percentile(rates[where], 95.0)) for where in (near, ~near)]
    evidence.append(Evidence("joint rate near, 95th percentile", peaks[0], "rad/s"))
    evidence.append(Evidence("joint rate elsewhere, 95th percentile", peaks[1], "rad/s"))
    return Measured(peaks[0] / max(peaks[1], 1e-9), rates, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """A margin of the manipulability, twice as wide as what counts as near."""
    model, _ = require_physics(env, "whose joints could be read")
    tip, dofs = _arm(model)
    largest, directions = _reach(model, tip, dofs)
    name = model.body(tip).name
    return (
        f"margin = sw.constraints.SingularityMargin(\n    threshold={NEAR * largest:.4g}, body={name!r}, "
        f"directions={directions!r}\n)\nenv = sw.CBFActionFilter(env, [margin])"
    ), ""


SYMPTOM = Symptom(
    "an arm that stalls or races near singular poses", "section 1.4.1, manipulability",
    2.0, "times", ("largest joint rate", "rad/s"), measure, lines, policies_only=True,
)  # fmt: skip
