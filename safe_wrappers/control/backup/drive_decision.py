"""The search for the closest admissible control of a heading drive among discs, in one compiled call.

The order of attempts is that of `SafeActionSearch`; the functions below it are for constraints that are not alone.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.backup.drive_among_discs import (
    Look,
    Scene,
    admits,
    backup_drive,
    look,
    passing_side,
    rows,
)
from safe_wrappers.control.numerics.compiled import compiled

_PARALLEL = 1e-12
"""Sine of the angle between two bounds below which their crossing is not looked for."""


@compiled
def _violated(x: float, y: float, normals: Array, offsets: Array, slack: float) -> bool:
    for i in range(offsets.size):
        length = math.sqrt(normals[i, 0] * normals[i, 0] + normals[i, 1] * normals[i, 1])
        if not normals[i, 0] * x + normals[i, 1] * y - offsets[i] <= slack * length:
            return True
    return False


@compiled
def project_in_plane(
    u: Array, normals: Array, offsets: Array, low: Array, high: Array, slack: float, out: Array
) -> bool:
    """The point closest to `u` with `normals @ x <= offsets` and `low <= x <= high`.

    Args:
        u: Shape (2,).
        normals: Shape (k, 2); their lengths are units of the offsets per unit of x.
        offsets: Shape (k,).
        low: Box, shape (2,).
        high: Box, shape (2,).
        slack: Distance by which an answer may break a row, in units of x.
        out: The answer, shape (2,); left alone if there is none.

    Returns:
        Whether there is such a point.
    """
    k = offsets.size
    all_normals, all_offsets = np.zeros((k + 4, 2)), np.zeros(k + 4)
    for i in range(k):
        all_normals[i, 0], all_normals[i, 1], all_offsets[i] = normals[i, 0], normals[i, 1], offsets[i]
    for j in range(2):
        all_normals[k + 2 * j, j], all_offsets[k + 2 * j] = 1.0, high[j]
        all_normals[k + 2 * j + 1, j], all_offsets[k + 2 * j + 1] = -1.0, -low[j]
    if not _violated(u[0], u[1], all_normals, all_offsets, slack):
        out[0], out[1] = u[0], u[1]
        return True
    best, found, n = math.inf, False, k + 4
    best_x, best_y = u[0], u[1]
    for i in range(n):
        a, b, c = all_normals[i, 0], all_normals[i, 1], all_offsets[i]
        square = a * a + b * b
        if not (square > 0.0 and a * u[0] + b * u[1] >= c):
            continue  # the closest point lies on a bound that u breaks, or where one of those meets another
        for j in range(n):
            if j == i:
                share = (c - a * u[0] - b * u[1]) / square
                x, y = u[0] + share * a, u[1] + share * b
            else:
                d, e, f = all_normals[j, 0], all_normals[j, 1], all_offsets[j]
                cross = a * e - b * d
                if not abs(cross) > _PARALLEL * math.sqrt(square * (d * d + e * e)):
                    continue
                x, y = (c * e - b * f) / cross, (a * f - c * d) / cross
            away = (x - u[0]) * (x - u[0]) + (y - u[1]) * (y - u[1])
            if away < best and not _violated(x, y, all_normals, all_offsets, slack):
                best, best_x, best_y, found = away, x, y, True
    if found:
        out[0] = min(max(best_x, low[0]), high[0])
        out[1] = min(max(best_y, low[1]), high[1])
    return found


ROWS_SLACK: Final = 1e-9
"""By how much of a control's range a projected control may break a row; prediction judges it afterwards."""
OVERSHOOTS: Final = (0.02, 0.1)
BLENDS: Final = (0.1, 0.25, 0.5, 0.75)
TRIES: Final = 3
PROPOSAL, ROWS, CANDIDATE, OVERSHOOT, BLEND, BACKUP, UNRESOLVED = 0, 1, 2, 4, 5, 6, 7
"""What `closest_admitted` returns: a `Stage` of the search, or that none of these has found an admissible control."""


@compiled
def _decide(
    at: Look, proposal: Array, side: float, detour: bool, bounds: Array, out: Array
) -> tuple[int, float, Array, Array]:
    """The closest admissible (drive, turn) that a search finds, in the order of `filter/search.py`.

    Args:
        at: The present state.
        proposal: Inside the box, shape (2,).
        side: Of a detour that goes on, or 0.
        detour: Whether to try ways around before projecting.
        bounds: Low and high of the controls, least and most between which the forces still change, shape (4, 2).
        out: What to execute, shape (2,).

    Returns:
        The stage that found it (UNRESOLVED: none did); the side of a detour that was tried, or 0; the rows that the
        control keeps, shapes (k, 2) and (k,).
    """
    low, high, least, most = bounds[0], bounds[1], bounds[2], bounds[3]
    drive, turn = proposal[0], proposal[1]
    out[0], out[1] = drive, turn
    normals, offsets = np.zeros((0, 2)), np.zeros(0)
    if admits(at, drive, turn):
        return PROPOSAL, 0.0, normals, offsets
    way = 0.0
    if detour:
        way = passing_side(at, drive, turn, side)
        if way != 0.0:
            around = min(max(way, low[1]), high[1])
            for ahead in (drive, min(max(0.0, low[0]), high[0])):
                if admits(at, ahead, around):
                    out[0], out[1] = ahead, around
                    return CANDIDATE, way, normals, offsets
    # Measured in shares of what acts: a control that saturates early must not look cheap to change.
    unit, force, inner_low, inner_high = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    for j in range(2):
        unit[j] = 1.0
        if most[j] > least[j]:
            unit[j] = (most[j] - least[j]) / (high[j] - low[j])
        force[j] = min(max(proposal[j], least[j]), most[j]) / unit[j]
        inner_low[j], inner_high[j] = least[j] / unit[j], most[j] / unit[j]
    found, exact = rows(at)
    scaled, tighter = np.zeros((exact.size, 2)), np.zeros(exact.size)
    for i in range(exact.size):
        scaled[i, 0], scaled[i, 1] = found[i, 0] * unit[0], found[i, 1] * unit[1]
    slack = ROWS_SLACK * max(inner_high[0] - inner_low[0], inner_high[1] - inner_low[1])
    answer, refused = np.zeros(2), np.zeros(2)
    refused[0], refused[1] = drive, turn
    feasible = project_in_plane(force, scaled, exact, inner_low, inner_high, slack, answer)
    if feasible:
        normals, offsets = found, exact
        # A component that saturates as the policy's did stays the policy's: the force is the same.
        for j in range(2):
            refused[j] = proposal[j] if answer[j] == force[j] else answer[j] * unit[j]
        if admits(at, refused[0], refused[1]):
            out[0], out[1] = refused[0], refused[1]
            return ROWS, way, normals, offsets
        for share in OVERSHOOTS:
            for i in range(exact.size):
                excess = max(found[i, 0] * drive + found[i, 1] * turn - exact[i], 0.0)
                tighter[i] = exact[i] - share * excess
            if project_in_plane(force, scaled, tighter, inner_low, inner_high, slack, answer):
                ahead = drive if answer[0] == force[0] else answer[0] * unit[0]
                around = turn if answer[1] == force[1] else answer[1] * unit[1]
                if admits(at, ahead, around):
                    out[0], out[1] = ahead, around
                    return OVERSHOOT, way, normals, offsets
    none, nothing = np.zeros((0, 2)), np.zeros(0)
    back = min(max(backup_drive(at), low[0]), high[0])
    if not admits(at, back, 0.0):
        return UNRESOLVED, way, none, nothing
    far, near = 0.0, 1.0  # shares of the way from the proposal to the backup: refused, and admitted
    for _ in range(TRIES):
        share = far + 0.5 * (near - far)
        ahead, around = drive + share * (back - drive), turn + share * (0.0 - turn)
        if admits(at, ahead, around):
            near, out[0], out[1] = share, ahead, around
        else:
            far = share
    if near < 1.0:
        return BLEND, way, none, nothing
    for share in BLENDS:
        ahead, around = refused[0] + share * (back - refused[0]), refused[1] + share * (0.0 - refused[1])
        if admits(at, ahead, around):
            out[0], out[1] = ahead, around
            return BLEND, way, none, nothing
    for mixed in range(2):
        ahead, around = (refused[0], 0.0) if mixed == 0 else (back, refused[1])
        if admits(at, ahead, around):
            out[0], out[1] = ahead, around
            return BLEND, way, none, nothing
    out[0], out[1] = back, 0.0
    return BACKUP, way, none, nothing


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
def secants(scene: Scene) -> tuple[Array, Array]:
    """Half-spaces of (drive, turn) that keep the clearance, about: shapes (k, 2) and (k,)."""
    return rows(look(scene))


@compiled
def way_around(scene: Scene, drive: float, turn: float, side: float) -> float:
    """1 (left), -1 (right), or 0 with nothing to go around; `side` is that of a detour that goes on, or 0."""
    return passing_side(look(scene), drive, turn, side)


@compiled
def manoeuvre_drive(scene: Scene) -> float:
    """The drive control of the backup manoeuvre."""
    return backup_drive(look(scene))


@compiled
def closest_admitted(
    scene: Scene, proposal: Array, side: float, detour: bool, bounds: Array, out: Array
) -> tuple[int, float, Array, Array]:
    """`_decide` from the present state."""
    return _decide(look(scene), proposal, side, detour, bounds, out)


@compiled
def bounds_of(
    low: Array, high: Array, lower: Array, upper: Array, least: Array, most: Array, turns_first: bool
) -> Array:
    """The bounds of `closest_admitted` from the action box, the plant's bounds and its acting range, shapes (2,)."""
    bounds = np.empty((4, 2))
    for j in range(2):
        place = 1 - j if turns_first else j
        bottom, top = max(low[j], lower[j]), min(high[j], upper[j])
        bounds[0, place], bounds[1, place] = bottom, top
        bounds[2, place], bounds[3, place] = min(max(least[j], bottom), top), min(max(most[j], bottom), top)
    return bounds


@compiled
def _round_inside(out: Array, normals: Array, offsets: Array, low: Array, high: Array) -> None:
    """`cast_inside` of `control/numerics/projection.py` to single precision, in place."""
    sent, worst, most = np.empty(2, dtype=np.float32), -1, 0.0
    for j in range(2):
        sent[j] = np.float32(min(max(out[j], low[j]), high[j]))
    for i in range(len(offsets)):
        limit = max(offsets[i], normals[i, 0] * out[0] + normals[i, 1] * out[1])
        excess = normals[i, 0] * float(sent[0]) + normals[i, 1] * float(sent[1]) - limit
        if worst < 0 or excess > most:
            worst, most = i, excess
    for j in range(2):
        if worst >= 0 and most > 0.0 and normals[worst, j] != 0.0:
            towards = np.float32(-math.inf if normals[worst, j] > 0.0 else math.inf)
            sent[j] = min(max(np.nextafter(sent[j], towards), np.float32(low[j])), np.float32(high[j]))
        out[j] = float(sent[j])


@compiled
def admit_each(
    models: Array,
    motions: Array,
    discs: Array,
    first: NDArray[np.int64],
    reserve: float,
    proposals: Array,
    values: Array,
    admitted: NDArray[np.bool_],
) -> None:
    """Judges n robots.

    Args:
        models: As for one, of each, shape (n, 1 + c, 14).
        motions: Likewise, shape (n, 6).
        discs: All robots' discs, one after the other, shape (d, 3).
        first: Where each robot's discs begin, and the end, shape (n + 1,).
        reserve: The margin, m.
        proposals: (drive, turn), shape (n, 2).
        values: Written: as of `least_clearance`, m, shape (n,).
        admitted: Written: whether its proposal is admitted, shape (n,).
    """
    for i in range(len(motions)):
        at = look((models[i], motions[i], discs[first[i] : first[i + 1]], reserve))
        values[i] = at.value
        admitted[i] = admits(at, proposals[i, 0], proposals[i, 1])


@compiled
def decide_each(
    models: Array,
    motions: Array,
    discs: Array,
    first: NDArray[np.int64],
    reserve: float,
    proposals: Array,
    chosen: NDArray[np.int64],
    sides: Array,
    detour: bool,
    bounds: Array,
    single: bool,
    out: Array,
    stages: NDArray[np.int64],
) -> None:
    """`closest_admitted` for the `chosen` of n robots, shape (r,), rounded to what is sent.

    `sides`, shape (n,), hold the sides of detours that go on, and get those that were tried; `bounds` has shape
    (r, 4, 2); `single` says whether controls are sent with single precision. `out`, shape (n, 2), and `stages`,
    shape (n,), are written.
    """
    for r in range(len(chosen)):
        i = chosen[r]
        at = look((models[i], motions[i], discs[first[i] : first[i + 1]], reserve))
        stage, side, normals, offsets = _decide(at, proposals[i], sides[i], detour, bounds[r], out[i])
        sides[i] = side
        if single:
            _round_inside(out[i], normals, offsets, bounds[r, 0], bounds[r, 1])
        stages[i] = stage if math.isfinite(out[i, 0]) and math.isfinite(out[i, 1]) else UNRESOLVED
