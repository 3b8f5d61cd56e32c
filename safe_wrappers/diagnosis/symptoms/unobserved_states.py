"""Occlusion and unobserved states: what the task counts and the observation never shows, however long one looks."""

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import Array
from safe_wrappers.constraints.limits.joints import driven_joints
from safe_wrappers.control.estimation.observability import unobservable_subspace
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.linear_model import Linearised
from safe_wrappers.diagnosis.recording import Env, Recording
from safe_wrappers.diagnosis.symptom import Measured, Symptom, replayed, require_physics
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.occlusion_penalty import OcclusionPenalty

STATES = 5
"""At which the env is linearised, over the run."""
WINDOW_S = 0.2
"""From one observation to the next that the rank is taken of: control steps that are shorter are put together."""
TOLERANCE = 1e-3
"""A state whose spread changes observations by less of theirs is not seen."""


class Others(NamedTuple):
    """What moves without being driven, and the machine."""

    machine: int  # its root body
    bodies: list[int]  # that move, of other trees


def _others(model: mujoco.MjModel) -> Others:
    roots = [int(model.body_rootid[model.jnt_bodyid[j]]) for j in driven_joints(model)]
    moving = {int(model.body_rootid[body]) for body in model.jnt_bodyid}
    bodies = [b for b in range(1, model.nbody) if model.body_rootid[b] in moving - set(roots)]
    return Others(roots[0] if roots else 0, bodies if roots else [])


def _places(model: mujoco.MjModel) -> Callable[[mujoco.MjData], Array]:
    """Where the others are, seen from the machine."""
    machine, bodies = _others(model)
    return lambda data: np.asarray(data.xpos[bodies] - data.xpos[machine]).ravel()


def _penalties(env: Env) -> list[OcclusionPenalty]:
    return [one for one in wrappers_of(env) if isinstance(one, OcclusionPenalty)]


def _tracked(env: Env, recording: Recording, step: int, data: mujoco.MjData) -> Callable[[], Array]:
    """The places of bodies whose estimates are shown, and may be relied on, in a control step."""
    bodies = [
        data.body(name).id
        for penalty in _penalties(env)
        if penalty.observe
        for name, expired in zip(
            penalty.track_names, recording.infos[step][keys.OCCLUSION_EXPIRED], strict=True
        )
        if not expired and "[" not in name
    ]
    return lambda: np.asarray(data.xpos[bodies]).ravel()


def unseen(a: Array, c: Array) -> Array:
    """Orthonormal basis of what outputs C x of x+ = A x never show, shape (n, k); states in comparable units."""
    return unobservable_subspace(a - np.eye(len(a)), c, TOLERANCE)


def _relative(c: Array) -> Array:
    """Rows of length one, but for those of nothing."""
    lengths = np.linalg.norm(c, axis=1, keepdims=True)
    return np.asarray(np.divide(c, lengths, out=np.zeros_like(c), where=lengths > 0.0))


class Hidden(NamedTuple):
    """At one state; bases in spreads, shape (n, k)."""

    all: Array  # of what observations never show
    idle: Array  # of what the task does not count either
    at_once: int  # directions that a single observation does not show


def _hidden(linear: Linearised, step: int, more: Callable[[], Array], together: int) -> Hidden:
    slopes = linear.at(step, more)
    a, c = np.linalg.matrix_power(slopes.a, together), _relative(slopes.c)
    basis = unseen(a, c)
    at_once = unseen(np.eye(len(a)), c).shape[1]
    if not basis.shape[1]:
        return Hidden(basis, basis, at_once)
    # What is never shown moves nothing that is: it is a system of its own, whose outputs are what the task counts.
    counted = TOLERANCE * linear.counted(step, basis)
    return Hidden(basis, basis @ unseen(basis.T @ a @ basis, counted), at_once)


def measure(env: Env, recording: Recording) -> Measured:
    """The number of directions of the state that the task counts and observations do not show; its lower median."""
    model, data = require_physics(env, "that could be linearised")
    linear = Linearised(env, recording, _places(model))
    together = max(round(WINDOW_S / recording.control_dt), 1)
    usable = np.flatnonzero(~recording.diverged)
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, STATES + 1).astype(int)[1:])]
    found_at = [
        _hidden(linear, int(step), _tracked(env, recording, int(step), data), together) for step in chosen
    ]
    counts = np.array([one.all.shape[1] - one.idle.shape[1] for one in found_at])
    several = [one.at_once - one.all.shape[1] for one in found_at]
    shares = [[(basis**2).sum(axis=1) for basis in (one.all, one.idle)] for one in found_at]
    hidden_share, idle_share = np.median(shares, axis=0)
    evidence = [
        Evidence("directions of the state that moved", float(len(linear.names)), ""),
        Evidence("that one observation does not show, and several do", float(np.median(several)), ""),
        *(
            Evidence(f"not shown, spread: {name}", float(spread), "")
            for name, spread, share in zip(
                linear.names, linear.spread, hidden_share - idle_share, strict=True
            )
            if share > 0.5
        ),
        *(
            Evidence(f"not shown, and without effect, spread: {name}", float(spread), "")
            for name, spread, share in zip(linear.names, linear.spread, idle_share, strict=True)
            if share > 0.5
        ),
        *_out_of_sight(env, recording),
    ]
    nearest = np.abs(np.arange(len(recording.qpos))[:, None] - chosen).argmin(axis=1)
    figure = float(np.sort(counts)[(len(counts) - 1) // 2])
    return Measured(figure, counts[nearest].astype(float), evidence)


def _out_of_sight(env: Env, recording: Recording) -> list[Evidence]:
    """Of what an `OcclusionPenalty` tracks."""
    penalties = _penalties(env)
    if not penalties:
        return []
    seen = np.array([info[keys.OCCLUSION_VISIBLE] for info in recording.infos])
    longest, run = 0, np.zeros(seen.shape[1], dtype=int)
    for first, row in zip(recording.first, seen, strict=True):
        run = np.where(row, 0, np.where(first, 1, run + 1))
        longest = max(longest, int(run.max()))
    return [
        Evidence("longest time that a tracked thing is out of sight", longest * recording.control_dt, "s"),
        Evidence("out of sight, of all tracked things", float(1.0 - seen.mean()), "share"),
    ]


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """Tracks of what moves by itself and is not shown, where the machine has a camera or a site to look from."""
    model, _ = require_physics(env, "that could be linearised")
    told = (
        "Show them: put them into the observation, or estimate them (OcclusionPenalty tracks bodies and published "
        "positions). A policy has to be trained with the new observation."
    )
    bodies, velocities = _velocities(model, recording)
    sensor = _sensor(model)
    named = [model.body(b).name for b in bodies]
    if not bodies or not sensor or not all(named) or _penalties(env):
        return "", told
    mean, deviation = velocities.mean(axis=0), velocities.std(axis=0).max(axis=0)
    noise, memory_s = _wander(velocities - mean, recording)
    memory = f", reversion_s={memory_s:.3g}" if np.isfinite(memory_s) else ""
    means = ", ".join(f"{name!r}: {_plain(each)}" for name, each in zip(named, mean, strict=True))
    touching = _radius(model, [_others(model).machine]) + _radius(model, bodies)
    return (
        f"means = {{{means}}}\n"
        "tracks = [\n"
        f"    sw.occlusion.Track(name, acceleration_noise={_plain(noise)}, mean_velocity=mean,\n"
        f"                       start_velocity_std={_plain(deviation)}{memory})\n"
        "    for name, mean in means.items()\n"
        "]\n"
        f"env = sw.OcclusionPenalty(env, tracks, {sensor}, tolerance={max(touching, 1e-3):.3g})",
        "Noise and speeds are those of the run; the tolerance is the distance at which they touch: say what error "
        f"your task can bear. {told}",
    )


def _radius(model: mujoco.MjModel, bodies: list[int]) -> float:
    """Of the largest ball around a geom of some bodies, m."""
    return float(model.geom_rbound[np.isin(model.geom_bodyid, bodies)].max(initial=0.0))


def _wander(off: Array, recording: Recording) -> tuple[Array, float]:
    """Of velocities less their means, (k, bodies, 2): the noise of each axis, m^2/s^3, and how long they last, s.

    A velocity that goes back to its mean with time constant tau keeps exp(-dt / tau) of itself in a control step.
    """
    before, after = (part[~recording.first[1:]] for part in (off[:-1], off[1:]))
    kept = float((before * after).sum() / max(float((before * before).sum()), 1e-12))
    left = after - kept * before
    memory_s = -recording.control_dt / np.log(kept) if 0.0 < kept < 1.0 else np.inf
    return left.var(axis=0).max(axis=0) / recording.control_dt, memory_s


def _plain(numbers: Array) -> str:
    return "[" + ", ".join(f"{number + 0.0:.3g}" for number in numbers) + "]"


def _velocities(model: mujoco.MjModel, recording: Recording) -> tuple[list[int], Array]:
    """Bodies of others that have moved in the plane, and their velocities, shape (k, bodies, 2), m/s."""
    bodies, found = _others(model).bodies, np.zeros(6)
    velocities = np.zeros((len(recording.qpos), len(bodies), 2))
    for k, data in replayed(model, recording):
        for i, body in enumerate(bodies):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, found, 0)
            velocities[k, i] = found[3:5]
    moved = np.flatnonzero(np.abs(velocities).max(axis=(0, 2), initial=0.0) > 0.0)
    return [bodies[i] for i in moved], velocities[:, moved]


def _sensor(model: mujoco.MjModel) -> str:
    """A camera of the machine's, else a site, as `OcclusionPenalty` takes it; "" for none."""
    machine = _others(model).machine
    for kind, count, owners in (
        ("camera", model.ncam, model.cam_bodyid),
        ("site", model.nsite, model.site_bodyid),
    ):
        for i in range(count):
            name = getattr(model, kind)(i).name
            if name and machine and model.body_rootid[owners[i]] == machine:
                return f"sw.occlusion.Sensor({kind}={name!r})"
    return ""


SYMPTOM = Symptom(
    "states that count and are never shown: occluded, or left out", "section 1.6, covariance and observability",
    1.0, "directions", ("directions not shown", "directions"), measure, lines, least=True,
)  # fmt: skip
