"""A heading drive among discs: which controls leave its stopping path clear. The rules of `HeadingDriveClearance`.

The closed form of the stopping path is off by a millimetre or two: under the backup manoeuvre its clearance may fall
by that. So the manoeuvre is admitted for what it is and not for the clearance that it leaves; and within `CLOSE_M` of
a disc the physics steps of a control, and of the manoeuvre after it until rest, are predicted one by one: where that
way is clear, so is what is left of it at the next control step.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.checks import Array
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
from safe_wrappers.control.numerics.compiled import compiled, hypot

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


class Look(NamedTuple):
    """What is known at an observation.

    Attributes:
        motion: Of the body.
        path: From there, without any further control but the backup manoeuvre's.
        discs: Those that one hold can bring into play: x, y and the distance to keep, m, shape (k, 3).
        least: The least clearance of all discs, m; NaN if one is not a number.
        value: The same, margin not taken off; at least 0 if the way until rest is clear, below 0 if it is not, and
            beyond what the actuators reach.
        safe: Whether the way of the backup manoeuvre until rest is clear, margin not taken off.
        reserve: The margin, m.
        loss: The most that one hold can use up, m.
        swivel: Twice the distance of the centre of mass from the turning axis, m.
    """

    motion: Motion
    path: StoppingPath
    discs: Array
    least: float
    value: float
    safe: bool
    reserve: float
    loss: float
    swivel: float


@compiled
def _body(constants: Array) -> HeadingDrive:
    c = constants
    return HeadingDrive(
        c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], int(c[11]), c[12], c[13]
    )


@compiled
def _to_disc(path: StoppingPath, swivel: float, x: float, y: float, room: float) -> float:
    if path.spread:  # it may come to rest anywhere in the area
        return path_distance(path, x, y) - swivel - room
    return min(path_distance(path, x, y), end_distance(path, x, y) - swivel) - room


@compiled
def _ends(body: HeadingDrive, m: Motion, brake: bool) -> tuple[float, float]:
    """The drive controls that brake and that push on, as far as the drive acts."""
    ahead = m.vx * math.cos(m.heading) + m.vy * math.sin(m.heading)
    full = body.drive_limit / body.drive_gain
    return brake_control(body, ahead) if brake else 0.0, math.copysign(full, ahead)


@compiled
def _least_on_the_way(
    body: HeadingDrive,
    truth: HeadingDrive,
    start: Motion,
    drive: float,
    turn: float,
    brake: bool,
    discs: Array,
    reserve: float,
) -> float:
    """The least clearance, margin not taken off, m, of a held control and then of the backup until rest.

    Of all physics steps, the present place included, until a disc is touched or none is within reach any more.
    """
    motion, least, near = start, math.inf, math.inf
    for i in range(len(discs)):
        least = min(least, hypot(discs[i, 0] - start.x, discs[i, 1] - start.y) - discs[i, 2] + reserve)
    control_dt = truth.timestep * truth.substeps
    coast, ahead, around = truth.mass / truth.damping, drive, turn
    for _ in range(int(REST * coast / control_dt) + 1):
        if least < -HAIR_M:
            return least
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
        ahead, around = brake_control(body, forward) if brake else 0.0, 0.0
    return least


@compiled
def look(models: Array, motion: Array, discs: Array, brake: bool, reserve: float) -> Look:
    """Judge the present state.

    Args:
        models: Constants of the body, then of each corner of its uncertainty, shape (1 + c, 14).
        motion: As `Motion`, shape (6,).
        discs: x, y and the distance to keep from there, margin in it, m, shape (n, 3).
        brake: Whether the backup manoeuvre brakes along the heading.
        reserve: The margin, m.
    """
    body = _body(models[0])
    now = Motion(motion[0], motion[1], motion[2], motion[3], motion[4], motion[5])
    path = stopping_path(body, now, brake)
    swivel = 2.0 * abs(body.com_offset)
    control_dt = body.timestep * body.substeps
    coast = body.mass * (1.0 + body.uncertainty) / (body.damping * (1.0 - body.uncertainty))
    change = body.drive_limit / (body.mass * (1.0 - body.uncertainty)) * control_dt
    turn = control_dt * min(body.yaw_limit / max(body.yaw_damping, 1e-12), math.pi / control_dt)
    speed = hypot(now.vx, now.vy) + abs(body.com_offset * now.yaw_rate)
    loss = change * (control_dt + coast) + speed * (control_dt + turn * coast)
    n, kept, best = len(discs), path.radius + swivel, math.inf
    order, bounds = np.zeros((n, 3)), np.zeros(n)
    for i in range(n):
        bound = hypot(discs[i, 0] - now.x, discs[i, 1] - now.y) - discs[i, 2] - kept
        if bound != bound:
            return Look(now, path, order[:0], math.nan, math.nan, False, reserve, loss, swivel)
        place = i
        while place > 0 and bounds[place - 1] > bound:
            bounds[place] = bounds[place - 1]
            for j in range(3):
                order[place, j] = order[place - 1, j]
            place -= 1
        bounds[place] = bound
        for j in range(3):
            order[place, j] = discs[i, j]
    for i in range(n):
        if not bounds[i] < best:
            break
        best = min(best, _to_disc(path, swivel, order[i, 0], order[i, 1], order[i, 2]))
    # Farther discs cannot come into play within one hold, whatever the control.
    cutoff, close = 2.0 * (loss + RESERVE_M), 0
    if best < cutoff:
        while close < n and bounds[close] < cutoff:
            close += 1
    value, exact = best + reserve, math.inf
    if value < CLOSE_M:
        braking = _ends(body, now, brake)[0]
        for i in range(1, len(models)):
            truth = _body(models[i])
            least = _least_on_the_way(body, truth, now, braking, 0.0, brake, order, reserve)
            exact = min(exact, least)
    safe, beyond = exact >= -HAIR_M, beyond_reach(body, now)
    value = max(value, 0.0) if safe else min(value, exact)
    if beyond > 0.0:
        value = min(value, -beyond * loss)
    return Look(now, path, order[:close], best, value, safe, reserve, loss, swivel)


@compiled
def _least_of(path: StoppingPath, at: Look) -> float:
    least = math.inf
    for i in range(len(at.discs)):
        least = min(least, _to_disc(path, at.swivel, at.discs[i, 0], at.discs[i, 1], at.discs[i, 2]))
    return least


@compiled
def _after(
    model: Array, body: HeadingDrive, at: Look, drive: float, turn: float, brake: bool
) -> StoppingPath:
    """The stopping path at the end of a held control, predicted with one model of the uncertainty."""
    return stopping_path(body, predict(_body(model), at.motion, drive, turn), brake)


@compiled
def _least_after(models: Array, at: Look, drive: float, brake: bool) -> float:
    least, body = math.inf, _body(models[0])
    for i in range(1, len(models)):
        least = min(least, _least_of(_after(models[i], body, at, drive, 0.0, brake), at))
    return least


@compiled
def _needed(at: Look, i: int, backup: StoppingPath) -> float:
    """The clearance that a control must leave of a disc, from inside the safe set: a share of today's."""
    x, y, room = at.discs[i, 0], at.discs[i, 1], at.discs[i, 2]
    now = max(_to_disc(at.path, at.swivel, x, y, room), 0.0)
    target = RESERVE_M + (1.0 - DECAY_PER_HOLD) * max(0.0, now - RESERVE_M)
    # Never more than the backup manoeuvre leaves: it is what makes the constraint always feasible.
    return min(target, _to_disc(backup, at.swivel, x, y, room))


@compiled
def _recovery(models: Array, at: Look, brake: bool) -> tuple[float, float]:
    """From outside: the drive control that recovers best, and the least clearance of all discs that it leaves, m."""
    body = _body(models[0])
    drive = _ends(body, at.motion, brake)[0]
    full = body.drive_limit / body.drive_gain
    best = _least_after(models, at, drive, brake)
    for other in (full, -full):
        left = _least_after(models, at, other, brake)
        if left > best:
            drive, best = other, left
    return drive, best


@compiled
def _aim(body: HeadingDrive, at: Look, best: float) -> float:
    """From outside: the clearance to aim at, m, where the best drive control leaves `best`."""
    # As much recovery as the drive can give here: across the heading it can give none.
    return min(at.least * (1.0 - RECOVERY_RATE * body.timestep * body.substeps), best)


@compiled
def _needed_outside(body: HeadingDrive, at: Look, best: float) -> float:
    """The least clearance of all discs that a control must leave, once one of them is lost."""
    return 0.25 * _aim(body, at, best) + 0.75 * at.least  # a quarter of what the rows aim at will do


@compiled
def _keeps_clear(models: Array, at: Look, least: float, drive: float, turn: float, brake: bool) -> bool:
    """Whether a control that leaves this clearance leads, step by step, to rest without touching a disc."""
    if not at.safe or min(at.value, least + at.reserve) >= CLOSE_M:
        return True  # an unsafe state promises nothing; elsewhere the closed form says it
    body = _body(models[0])
    for i in range(1, len(models)):
        truth, start = _body(models[i]), at.motion
        if _least_on_the_way(body, truth, start, drive, turn, brake, at.discs, at.reserve) < HAIR_M:
            return False
    return True


@compiled
def admits(models: Array, at: Look, drive: float, turn: float, brake: bool) -> bool:
    """Whether the end of a held control still has a safe stopping path, for every model of the uncertainty.

    From a safe state the backup manoeuvre itself is always admitted.

    Args:
        models: As for `look`.
        at: The present state.
        drive: Control along the heading.
        turn: Control about the axis.
        brake: Whether the backup manoeuvre brakes along the heading.
    """
    if not len(at.discs):
        return True
    body = _body(models[0])
    outside, needed, least, refused = at.least < 0.0, 0.0, math.inf, False
    braking = _ends(body, at.motion, brake)[0]
    if outside:
        best = _recovery(models, at, brake)[1]
        needed = _needed_outside(body, at, best)
    for i in range(1, len(models)):
        if refused:
            break
        path = _after(models[i], body, at, drive, turn, brake)
        if outside:
            least = min(least, _least_of(path, at))
            refused = least < needed
        else:
            backup = _after(models[i], body, at, braking, 0.0, brake)
            for j in range(len(at.discs)):
                left = _to_disc(path, at.swivel, at.discs[j, 0], at.discs[j, 1], at.discs[j, 2])
                least = min(least, left)
                if left < at.loss and left < _needed(at, j, backup) * (1.0 - ROW_SLACK):
                    refused = True
                    break
    if not refused and _keeps_clear(models, at, least, drive, turn, brake):
        return True
    if not at.safe or turn != 0.0:
        return False
    full = body.drive_limit / body.drive_gain
    acting = max(-full, min(drive, full))
    return abs(acting - backup_drive(models, at, brake)) <= SAME * full


@compiled
def rows(models: Array, at: Look, brake: bool) -> tuple[Array, Array]:
    """Secants of the clearance after one hold over (drive, turn), one row per model and disc in play.

    Returns:
        `normals @ (drive, turn) <= offsets`: shapes (k, 2) and (k,), rows that no control can break left out.
    """
    near, outside = len(at.discs), at.least < 0.0
    each = 1 if outside else near
    normals, offsets, k = np.zeros(((len(models) - 1) * each, 2)), np.zeros((len(models) - 1) * each), 0
    if near == 0:
        return normals[:0], offsets[:0]
    body = _body(models[0])
    braking, pushing = _ends(body, at.motion, brake)
    aim = 0.0
    if outside:
        best = _recovery(models, at, brake)[1]
        aim = _aim(body, at, best)
    for i in range(1, len(models)):
        base = _after(models[i], body, at, braking, 0.0, brake)
        pushed = _after(models[i], body, at, pushing, 0.0, brake)
        left = _after(models[i], body, at, braking, 1.0, brake)
        right = _after(models[i], body, at, braking, -1.0, brake)
        for j in range(each):
            if outside:
                needed = aim
                at_brake, by_push = _least_of(base, at), _least_of(pushed, at)
                by_left, by_right = _least_of(left, at), _least_of(right, at)
            else:
                x, y, room = at.discs[j, 0], at.discs[j, 1], at.discs[j, 2]
                needed = _needed(at, j, base)
                at_brake, by_push = (
                    _to_disc(base, at.swivel, x, y, room),
                    _to_disc(pushed, at.swivel, x, y, room),
                )
                by_left, by_right = (
                    _to_disc(left, at.swivel, x, y, room),
                    _to_disc(right, at.swivel, x, y, room),
                )
            by_drive, by_turn = (by_push - at_brake) / (pushing - braking), 0.5 * (by_left - by_right)
            if at_brake + min(0.0, by_drive * (pushing - braking)) - abs(by_turn) >= needed:
                continue
            normals[k, 0], normals[k, 1] = -by_drive, -by_turn
            offsets[k] = at_brake - by_drive * braking - needed + HAIR_M
            k += 1
    return normals[:k], offsets[:k]


@compiled
def passing_side(models: Array, at: Look, drive: float, turn: float, brake: bool, side: float) -> float:
    """The way to turn to get around the disc in the way: 1 left, -1 right, 0 if there is nothing to go around.

    `side` is that of a detour that goes on already, or 0.
    """
    if not len(at.discs) or drive == 0.0:
        return 0.0
    m, body = at.motion, _body(models[0])
    ahead, beside = math.cos(m.heading), math.sin(m.heading)
    if drive < 0.0:
        ahead, beside = -ahead, -beside
    path = _after(models[1], body, at, drive, turn, brake)
    nearest, across, least = False, 0.0, math.inf
    for i in range(len(at.discs)):
        x, y, room = at.discs[i, 0], at.discs[i, 1], at.discs[i, 2]
        if (x - m.x) * ahead + (y - m.y) * beside > 0.0:
            left = _to_disc(path, at.swivel, x, y, room)
            if left < least or not nearest:
                nearest, least, across = True, left, ahead * (y - m.y) - beside * (x - m.x)
    if not nearest:
        return 0.0  # driving away from all of them
    if side != 0.0:
        return side
    # A disc to the right of the drive is passed on the left.
    return 1.0 if across <= 0.0 else -1.0


@compiled
def backup_drive(models: Array, at: Look, brake: bool) -> float:
    """The drive control of the backup manoeuvre; from inside a disc, or its margin, the one that leads out best."""
    body = _body(models[0])
    braking = _ends(body, at.motion, brake)[0]
    if not at.least < 0.0:
        return braking
    drive, best = _recovery(models, at, brake)
    if at.safe and best < _needed_outside(body, at, best):
        return braking
    return drive if _keeps_clear(models, at, best, drive, 0.0, brake) else braking
