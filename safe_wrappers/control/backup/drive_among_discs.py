"""A heading drive among discs: which controls leave its stopping path clear. The rules of `HeadingDriveClearance`.

The closed form of the stopping path is off by a millimetre or two: under the backup manoeuvre its clearance may fall
by that. So the manoeuvre is admitted for what it is and not for the clearance that it leaves; and within `CLOSE_M` of
a disc the physics steps of a control, and of the manoeuvre after it until rest, are predicted one by one: where that
way is clear, so is what is left of it at the next control step.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.control.backup.heading_drive import (
    HeadingDrive,
    Motion,
    StoppingPath,
    advance,
    beyond_reach,
    brake_control,
    com_speed,
    end_distance,
    path_distance,
    predict,
    stopping_path,
)
from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array

RECOVERY_RATE: Final = 1.0
"""1/s: an unsafe start must shrink its violation at least this fast, where the drive can."""
DECAY_PER_HOLD: Final = 0.5
"""The share of the clearance that one hold may use up: the discrete class-K decay, alpha times the hold."""
ROW_SLACK: Final = 0.02
"""The share of the needed clearance that prediction may miss of what the linear rows aimed at."""
HAIR_M: Final = 1e-7
"""Between two discs at rest the rows of both meet at one control; this much slack lets a solver find it."""
RESERVE_M: Final = 0.001
"""Kept free before the boundary for what the closed form leaves out; only the backup may use it."""
CLOSE_M: Final = 0.002
"""Clearance, margin not taken off, below which the closed form is not relied on."""
SAME: Final = 1e-6
"""Drives that differ by a smaller share of the full drive are the same: actions are rounded."""
REST: Final = 16.0
"""Time until rest, in time constants of the coasting: of 1 m, 0.1 um are left."""

Scene = tuple[Array, Array, Array, float]
"""What is seen, as a plain tuple, which compiled code takes fastest.

* models: constants of the body, then of each corner of its uncertainty, shape (1 + c, 14)
* motion: as `Motion`, shape (6,)
* discs: x, y and the distance to keep from there, margin in it, m, shape (n, 3)
* reserve: the margin, m
"""


class Look(NamedTuple):
    """What is known at an observation.

    Attributes:
        models: As in `Scene`.
        body: The first of them.
        motion: Of the body.
        path: From there, without any further control but the backup manoeuvre's.
        discs: Those that one hold can bring into play: x, y and the distance to keep, m, shape (k, 3).
        least: The least clearance of all discs, m; NaN if one is not a number.
        value: The same, margin not taken off; at least 0 if the way until rest is clear, below 0 if it is not, and
            beyond what the actuators reach.
        safe: Whether the way of the backup manoeuvre until rest is clear, margin not taken off.
        reserve: The margin, m.
        loss: The most that one hold can use up, m.
    """

    models: Array
    body: HeadingDrive
    motion: Motion
    path: StoppingPath
    discs: Array
    least: float
    value: float
    safe: bool
    reserve: float
    loss: float


@compiled
def _body(constants: Array) -> HeadingDrive:
    c = constants
    return HeadingDrive(
        c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], int(c[11]), c[12], c[13]
    )


@compiled
def _swivel(body: HeadingDrive) -> float:
    """Twice the distance of the centre of mass from the turning axis, m."""
    return 2.0 * abs(body.com_offset)


@compiled
def _to_disc(body: HeadingDrive, path: StoppingPath, disc: Array) -> float:
    x, y, room = float(disc[0]), float(disc[1]), float(disc[2])
    if path.spread:  # it may come to rest anywhere in the area
        return path_distance(path, x, y) - _swivel(body) - room
    return min(path_distance(path, x, y), end_distance(path, x, y) - _swivel(body)) - room


@compiled
def _ends(body: HeadingDrive, m: Motion) -> tuple[float, float]:
    """The drive controls that brake and that push on, as far as the drive acts."""
    ahead = m.vx * math.cos(m.heading) + m.vy * math.sin(m.heading)
    full = body.drive_limit / body.drive_gain
    return brake_control(body, ahead), math.copysign(full, ahead)


@compiled
def _least_on_the_way(
    models: Array, start: Motion, drive: float, turn: float, discs: Array, reserve: float
) -> float:
    """The least clearance, margin not taken off, m, of a held control and then of the backup until rest.

    Of all physics steps and corners of the uncertainty, the present place included, until a disc is touched or none
    is within reach any more.
    """
    body, found = _body(models[0]), math.inf
    for k in range(1, len(models)):
        truth = _body(models[k])
        motion, least, near = start, math.inf, math.inf
        for i in range(len(discs)):
            least = min(least, hypot(discs[i, 0] - start.x, discs[i, 1] - start.y) - discs[i, 2] + reserve)
        control_dt = truth.timestep * truth.substeps
        coast, ahead, around = truth.mass / truth.damping, drive, turn
        for _ in range(int(REST * coast / control_dt) + 1):
            if least < -HAIR_M:
                break
            for _ in range(truth.substeps):
                motion = advance(truth, motion, ahead, around, 1)
                near = math.inf
                for i in range(len(discs)):
                    gap = hypot(discs[i, 0] - motion.x, discs[i, 1] - motion.y) - discs[i, 2] + reserve
                    near = min(near, gap)
                least = min(least, near)
            # The axis circles about the centre of mass, which coasts.
            if near > 2.0 * (coast * com_speed(truth, motion) + abs(truth.com_offset)):
                break
            forward = motion.vx * math.cos(motion.heading) + motion.vy * math.sin(motion.heading)
            ahead, around = brake_control(body, forward), 0.0
        found = min(found, least)
    return found


@compiled
def look(scene: Scene) -> Look:
    """Judge the present state."""
    models, motion, discs, reserve = scene
    body = _body(models[0])
    now = Motion(motion[0], motion[1], motion[2], motion[3], motion[4], motion[5])
    path = stopping_path(body, now)
    control_dt = body.timestep * body.substeps
    coast = body.mass * (1.0 + body.uncertainty) / (body.damping * (1.0 - body.uncertainty))
    change = body.drive_limit / (body.mass * (1.0 - body.uncertainty)) * control_dt
    turn = control_dt * min(body.yaw_limit / max(body.yaw_damping, 1e-12), math.pi / control_dt)
    speed = hypot(now.vx, now.vy) + abs(body.com_offset * now.yaw_rate)
    loss = change * (control_dt + coast) + speed * (control_dt + turn * coast)
    n, kept, best = len(discs), path.radius + _swivel(body), math.inf
    bounds = np.empty(n)
    for i in range(n):
        bounds[i] = hypot(discs[i, 0] - now.x, discs[i, 1] - now.y) - discs[i, 2] - kept
        if bounds[i] != bounds[i]:
            return Look(models, body, now, path, discs[:0].copy(), math.nan, math.nan, False, reserve, loss)
    nearest = np.argsort(bounds, kind="mergesort")
    order, bounds = discs[nearest], bounds[nearest]
    for i in range(n):
        if not bounds[i] < best:
            break
        best = min(best, _to_disc(body, path, order[i]))
    # Farther discs cannot come into play within one hold, whatever the control.
    cutoff, close = 2.0 * (loss + RESERVE_M), 0
    if best < cutoff:
        while close < n and bounds[close] < cutoff:
            close += 1
    value, exact = best + reserve, math.inf
    if value < CLOSE_M:
        exact = _least_on_the_way(models, now, _ends(body, now)[0], 0.0, order, reserve)
    safe, beyond = exact >= -HAIR_M, beyond_reach(body, now)
    value = max(value, 0.0) if safe else min(value, exact)
    if beyond > 0.0:
        value = min(value, -beyond * loss)
    return Look(models, body, now, path, order[:close], best, value, safe, reserve, loss)


@compiled
def _least_of(path: StoppingPath, at: Look) -> float:
    least = math.inf
    for i in range(len(at.discs)):
        least = min(least, _to_disc(at.body, path, at.discs[i]))
    return least


@compiled
def _after(at: Look, corner: int, drive: float, turn: float) -> StoppingPath:
    """The stopping path at the end of a held control, predicted with one model of the uncertainty, from 1 on."""
    return stopping_path(at.body, predict(_body(at.models[corner]), at.motion, drive, turn))


@compiled
def _least_after(at: Look, drive: float) -> float:
    least = math.inf
    for i in range(1, len(at.models)):
        least = min(least, _least_of(_after(at, i, drive, 0.0), at))
    return least


@compiled
def _needed(at: Look, disc: Array, backup: StoppingPath) -> float:
    """The clearance that a control must leave of a disc, from inside the safe set: a share of today's."""
    now = max(_to_disc(at.body, at.path, disc), 0.0)
    target = RESERVE_M + (1.0 - DECAY_PER_HOLD) * max(0.0, now - RESERVE_M)
    # Never more than the backup manoeuvre leaves: it is what makes the constraint always feasible.
    return min(target, _to_disc(at.body, backup, disc))


@compiled
def _braking(at: Look) -> float:
    return _ends(at.body, at.motion)[0]


@compiled
def _recovery(at: Look) -> tuple[float, float]:
    """From outside: the drive control that recovers best, and the least clearance of all discs that it leaves, m."""
    drive, full = _braking(at), at.body.drive_limit / at.body.drive_gain
    best = _least_after(at, drive)
    for other in (full, -full):
        left = _least_after(at, other)
        if left > best:
            drive, best = other, left
    return drive, best


@compiled
def _aim(at: Look, best: float) -> float:
    """From outside: the clearance to aim at, m, where the best drive control leaves `best`."""
    # As much recovery as the drive can give here: across the heading it can give none.
    return min(at.least * (1.0 - RECOVERY_RATE * at.body.timestep * at.body.substeps), best)


@compiled
def _needed_outside(at: Look, best: float) -> float:
    """The least clearance of all discs that a control must leave, once one of them is lost."""
    return 0.25 * _aim(at, best) + 0.75 * at.least  # a quarter of what the rows aim at will do


@compiled
def _keeps_clear(at: Look, least: float, drive: float, turn: float) -> bool:
    """Whether a control that leaves this clearance leads, step by step, to rest without touching a disc."""
    if not at.safe or min(at.value, least + at.reserve) >= CLOSE_M:
        return True  # an unsafe state promises nothing; elsewhere the closed form says it
    return _least_on_the_way(at.models, at.motion, drive, turn, at.discs, at.reserve) >= HAIR_M


@compiled
def admits(at: Look, drive: float, turn: float) -> bool:
    """Whether the end of a held control still has a safe stopping path, for every model of the uncertainty.

    From a safe state the backup manoeuvre itself is always admitted.
    """
    if not len(at.discs):
        return True
    outside, needed, least, refused = at.least < 0.0, 0.0, math.inf, False
    if outside:
        needed = _needed_outside(at, _recovery(at)[1])
    for i in range(1, len(at.models)):
        if refused:
            break
        path = _after(at, i, drive, turn)
        if outside:
            least = min(least, _least_of(path, at))
            refused = least < needed
        else:
            backup = _after(at, i, _braking(at), 0.0)
            for j in range(len(at.discs)):
                left = _to_disc(at.body, path, at.discs[j])
                least = min(least, left)
                if left < at.loss and left < _needed(at, at.discs[j], backup) * (1.0 - ROW_SLACK):
                    refused = True
                    break
    if not refused and _keeps_clear(at, least, drive, turn):
        return True
    if not at.safe or turn != 0.0:
        return False
    full = at.body.drive_limit / at.body.drive_gain
    acting = max(-full, min(drive, full))
    return abs(acting - backup_drive(at)) <= SAME * full


@compiled
def secants(scene: Scene) -> tuple[Array, Array]:
    """Secants of the clearance after one hold over (drive, turn), one row per model and disc in play.

    Returns:
        `normals @ (drive, turn) <= offsets`: shapes (k, 2) and (k,), rows that no control can break left out.
    """
    at = look(scene)
    near, outside = len(at.discs), at.least < 0.0
    each = 1 if outside else near
    normals, offsets, k = np.zeros(((len(at.models) - 1) * each, 2)), np.zeros((len(at.models) - 1) * each), 0
    if near == 0:
        return normals[:0], offsets[:0]
    braking, pushing = _ends(at.body, at.motion)
    needed = _aim(at, _recovery(at)[1]) if outside else 0.0
    left = np.zeros(4)  # by braking, by pushing on, and by braking while turning left and right
    for i in range(1, len(at.models)):
        base, pushed = _after(at, i, braking, 0.0), _after(at, i, pushing, 0.0)
        leftwards, rightwards = _after(at, i, braking, 1.0), _after(at, i, braking, -1.0)
        for j in range(each):
            if not outside:
                needed = _needed(at, at.discs[j], base)
            for m, path in enumerate((base, pushed, leftwards, rightwards)):
                left[m] = _least_of(path, at) if outside else _to_disc(at.body, path, at.discs[j])
            by_drive, by_turn = (left[1] - left[0]) / (pushing - braking), 0.5 * (left[2] - left[3])
            if left[0] + min(0.0, by_drive * (pushing - braking)) - abs(by_turn) >= needed:
                continue
            normals[k, 0], normals[k, 1] = -by_drive, -by_turn
            offsets[k] = left[0] - by_drive * braking - needed + HAIR_M
            k += 1
    return normals[:k], offsets[:k]


@compiled
def way_around(scene: Scene, drive: float, turn: float, side: float) -> float:
    """The way to turn to get around the disc in the way: 1 left, -1 right, 0 if there is nothing to go around.

    `side` is that of a detour that goes on already, or 0.
    """
    at = look(scene)
    if not len(at.discs) or drive == 0.0:
        return 0.0
    m = at.motion
    ahead, beside = math.cos(m.heading), math.sin(m.heading)
    if drive < 0.0:
        ahead, beside = -ahead, -beside
    path = _after(at, 1, drive, turn)
    nearest, across, least = False, 0.0, math.inf
    for i in range(len(at.discs)):
        x, y = at.discs[i, 0], at.discs[i, 1]
        if (x - m.x) * ahead + (y - m.y) * beside > 0.0:
            left = _to_disc(at.body, path, at.discs[i])
            if left < least or not nearest:
                nearest, least, across = True, left, ahead * (y - m.y) - beside * (x - m.x)
    if not nearest:
        return 0.0  # driving away from all of them
    if side != 0.0:
        return side
    # A disc to the right of the drive is passed on the left.
    return 1.0 if across <= 0.0 else -1.0


@compiled
def backup_drive(at: Look) -> float:
    """The drive control of the backup manoeuvre; from inside a disc, or its margin, the one that leads out best."""
    if not at.least < 0.0:
        return _braking(at)
    drive, best = _recovery(at)
    if at.safe and best < _needed_outside(at, best):
        return _braking(at)
    return drive if _keeps_clear(at, best, drive, 0.0) else _braking(at)


@compiled
def least_clearance(qpos: Array, qvel: Array, place: Array, scene: Scene) -> tuple[float, int]:
    """`Look.value`, m (NaN if a disc is not a number), and how many discs are in play.

    Writes the scene's motion: `place` has the indices of the first of its joints in qpos and qvel, and the body's
    place at qpos = 0, m.
    """
    motion = scene[1]
    for i in range(3):
        motion[i], motion[3 + i] = qpos[int(place[0]) + i], qvel[int(place[1]) + i]
    motion[0] += place[2]
    motion[1] += place[3]
    at = look(scene)
    return at.value, len(at.discs)


@compiled
def is_admitted(scene: Scene, drive: float, turn: float) -> bool:
    """Whether the end of a held control still has a safe stopping path."""
    return admits(look(scene), drive, turn)


@compiled
def manoeuvre_drive(scene: Scene) -> float:
    """The drive control of the backup manoeuvre."""
    return backup_drive(look(scene))
