"""A planar body driven along its heading: held controls, and braking along the heading until it rests.

The body slides in the plane with linear damping; its drive pushes along the heading, a speed servo turns it. Nothing
brakes it sideways: there it coasts. The equations are MuJoCo's physics step (semi-implicit Euler, damping implicit),
so a predicted trajectory is that of MuJoCo to rounding. The functions are compiled.

Source: appendix "Relative degree and kinetic stopping insets", for this plant.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array

REST_M: Final = 5e-4
"""A body that cannot get farther than this is as good as at rest."""
_LONGEST: Final = 16.0
"""Time after which it counts as at rest, in time constants of the coasting: of 1 m, 0.1 um are left."""
_SMALL: Final = 0.02
"""rad; turning by less, the sine and cosine of a physics step are a few terms, exact to rounding."""


class Motion(NamedTuple):
    """Position (m), heading (rad), velocity of the turning axis (m/s) and yaw rate (rad/s)."""

    x: float
    y: float
    heading: float
    vx: float
    vy: float
    yaw_rate: float


class HeadingDrive(NamedTuple):
    """Constants of the body.

    Attributes:
        mass: kg.
        damping: Linear damping of the plane motion, N s/m.
        com_offset: Centre of mass ahead of the turning axis, m.
        yaw_inertia: About the turning axis, kg m^2.
        yaw_damping: N m s/rad.
        drive_gain: Force along the heading per control, N.
        drive_limit: Largest drive force, N.
        yaw_gain: Turning torque per control, N m.
        yaw_feedback: Turning torque per yaw rate of a speed servo, N m s/rad (at most 0).
        yaw_limit: Largest turning torque, N m.
        timestep: Physics step, s.
        substeps: Physics steps per control step.
    """

    mass: float
    damping: float
    com_offset: float
    yaw_inertia: float
    yaw_damping: float
    drive_gain: float
    drive_limit: float
    yaw_gain: float
    yaw_feedback: float
    yaw_limit: float
    timestep: float
    substeps: int

    def corners(self, uncertainty: float) -> "list[HeadingDrive]":
        """The bodies with mass and damping at both ends of a relative uncertainty in (0, 1); none if it is 0."""
        factors = (1.0 - uncertainty, 1.0 + uncertainty) if uncertainty else ()
        return [
            self._replace(
                mass=self.mass * m,
                yaw_inertia=self.yaw_inertia * m,
                damping=self.damping * c,
                yaw_damping=self.yaw_damping * c,
            )
            for m in factors
            for c in factors
        ]


@compiled
def _body(constants: Array) -> HeadingDrive:
    c = constants
    return HeadingDrive(c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], int(c[11]))


@compiled
def _motion(m: Array) -> Motion:
    return Motion(m[0], m[1], m[2], m[3], m[4], m[5])


@compiled
def brake_control(body: HeadingDrive, motion: Motion) -> float:
    """The drive control that brakes fully, or just to rest within one control step."""
    ahead = motion.vx * math.cos(motion.heading) + motion.vy * math.sin(motion.heading)
    force = -ahead * body.mass / (body.timestep * body.substeps)
    return max(-body.drive_limit, min(force, body.drive_limit)) / body.drive_gain


@compiled
def advance(body: HeadingDrive, motion: Motion, drive: float, turn: float, places: Array) -> Motion:
    """Motion after both controls were held for one control step.

    Writes the position at the end of every physics step, m, and the heading's cosine and sine into `places`, shape
    (substeps, 4).
    """
    x, y, heading, vx, vy, yaw_rate = motion
    h, r, m = body.timestep, body.com_offset, body.mass
    push = max(-body.drive_limit, min(body.drive_gain * drive, body.drive_limit))
    along = 1.0 / (m + h * body.damping)
    m_l, m_c, m_w = m + h * body.damping, m * r, body.yaw_inertia + h * body.yaw_damping
    scale = h / (m_l * m_w - m_c * m_c)
    limit, damping, yaw_damping = body.yaw_limit, body.damping, body.yaw_damping
    wanted, feedback = body.yaw_gain * turn, body.yaw_feedback
    cos, sin = math.cos(heading), math.sin(heading)
    for i in range(body.substeps):
        ahead, aside = vx * cos + vy * sin, vy * cos - vx * sin
        torque = max(-limit, min(wanted + feedback * yaw_rate, limit)) - yaw_damping * yaw_rate
        drag = -damping * aside
        d_ahead = h * along * (push - damping * ahead + m_c * yaw_rate * yaw_rate)
        d_aside = scale * (m_w * drag - m_c * torque)
        yaw_rate += scale * (m_l * torque - m_c * drag)
        vx += d_ahead * cos - d_aside * sin
        vy += d_ahead * sin + d_aside * cos
        x += h * vx
        y += h * vy
        angle = h * yaw_rate
        heading += angle
        if abs(angle) < _SMALL:
            square = angle * angle
            c = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square / 720.0))
            s = angle * (1.0 - square * (1.0 / 6.0 - square / 120.0))
            cos, sin = cos * c - sin * s, sin * c + cos * s
        else:
            cos, sin = math.cos(heading), math.sin(heading)
        places[i, 0], places[i, 1], places[i, 2], places[i, 3] = x, y, cos, sin
    return Motion(x, y, heading, vx, vy, yaw_rate)


@compiled
def _com_speed(body: HeadingDrive, motion: Motion) -> float:
    """Speed of the centre of mass, m/s."""
    swing = body.com_offset * motion.yaw_rate
    return hypot(motion.vx - swing * math.sin(motion.heading), motion.vy + swing * math.cos(motion.heading))


@compiled
def _coasting(body: HeadingDrive, motion: Motion) -> tuple[float, float]:
    """Bounds on how far the centre of mass still gets while the body brakes, m, and on the angle that it turns, rad.

    The centre of mass coasts to rest within `m v / c`, and braking only shortens that. The hinge's damping alone ends
    the turning within `(I w + r m v) / d`, where `r m v` is what the damping of the axis does.
    """
    speed, r = _com_speed(body, motion), abs(body.com_offset)
    angle = (body.yaw_inertia * abs(motion.yaw_rate) + r * body.mass * speed) / body.yaw_damping
    return body.mass / body.damping * speed, angle


@compiled
def reach(body: HeadingDrive, motion: Motion, ahead: float) -> float:
    """A bound on how far a place ahead of the turning axis still gets while the body brakes, m.

    It swings about the centre of mass by the angle that the body still turns.
    """
    way, angle = _coasting(body, motion)
    return way + 2.0 * abs(ahead - body.com_offset) * angle


@compiled
def _gap(disc: Array, x: float, y: float, cos: float, sin: float) -> float:
    """From where the disc counts: at the turning axis, or ahead of it."""
    return hypot(disc[0] - x - disc[3] * cos, disc[1] - y - disc[3] * sin) - float(disc[2])


@compiled
def _end_gap(body: HeadingDrive, motion: Motion, disc: Array) -> float:
    """What is left at rest; at the axis, while the body turns in place: it then circles about the centre of mass."""
    cos, sin, r = math.cos(motion.heading), math.sin(motion.heading), body.com_offset
    if disc[3] != 0.0:
        return _gap(disc, motion.x, motion.y, cos, sin)
    return _gap(disc, motion.x + r * cos, motion.y + r * sin, cos, sin) - abs(r)


@compiled
def clearances(models: Array, start: Array, drive: float, turn: float, discs: Array, to_rest: bool) -> Array:
    """What a held control, and braking after it until rest, leaves of the distance to discs, m, shape (2, c n).

    The first row is the least at any physics step, the present one included; the second what is left at the end. A
    trajectory is followed as long as it can come closer to a disc than it was.

    A disc counts for a place on the heading. For the axis the end must be where the body can turn in place: else it
    could stand before a disc for good. For places ahead it need not: the body can back out.

    Args:
        models: Constants of bodies, shape (c, 12): of the one by which it brakes, and of others that it may be. The
            discs of the first come first.
        start: As `Motion`, shape (6,).
        drive: Held for one control step.
        turn: Likewise.
        discs: Of each centre, radius, and how far ahead of the axis it counts, m, shape (n, 4).
        to_rest: Whether all trajectories are followed until rest.
    """
    n = len(discs)
    every, gaps, brakes = np.full((2, len(models) * n), math.inf), np.empty(n), _body(models[0])
    places, lever = np.empty((brakes.substeps, 4)), np.empty(n)
    for which, model in enumerate(models):
        left = every[:, which * n : which * n + n]
        body, motion, way, angle = _body(model), _motion(start), math.inf, 0.0
        ahead, around, longest = drive, turn, 2.0 * abs(body.com_offset)
        cos, sin = math.cos(motion.heading), math.sin(motion.heading)
        for i in range(n):
            left[0, i] = gaps[i] = _gap(discs[i], motion.x, motion.y, cos, sin)
            lever[i] = 2.0 * abs(discs[i, 3] - body.com_offset)  # about the centre of mass, the widest swing
            longest = max(longest, lever[i])
        holds = int(_LONGEST * body.mass / (body.damping * body.timestep * body.substeps)) + 1
        for _ in range(holds):
            motion = advance(body, motion, ahead, around, places)
            before, turned, nears = way, angle, to_rest
            way, angle = _coasting(body, motion)
            for i in range(n):
                if gaps[i] - (before + lever[i] * turned) - lever[i] >= left[0, i]:
                    continue
                for k in range(body.substeps):
                    gaps[i] = _gap(discs[i], places[k, 0], places[k, 1], places[k, 2], places[k, 3])
                    if not gaps[i] >= left[0, i]:  # what is not a number stays
                        left[0, i] = gaps[i]
                nears = nears or gaps[i] - (way + lever[i] * angle) - lever[i] < left[0, i]
            if way + longest * angle < REST_M or not nears:
                break
            ahead, around = brake_control(brakes, motion), 0.0
        for i in range(n):
            left[1, i] = end = _end_gap(body, motion, discs[i])
            far = way + lever[i] * angle
            if not end - far >= left[0, i]:
                left[0, i] = end - far
    return every


class Sight(NamedTuple):
    """What is known at an observation.

    Attributes:
        motion: As `Motion`, shape (6,).
        brake: The drive control that brakes.
        discs: Those that one control step and braking after it can come near, or the nearest: shape (k, 4).
        clearances: What braking leaves of them, shape (2, c k).
        loss: The most that another control can leave less, m.
    """

    motion: Array
    brake: float
    discs: Array
    clearances: Array
    loss: float


@compiled
def look(models: Array, qpos: Array, qvel: Array, place: Array, discs: Array, margin: float) -> Sight:
    """Read the motion and find the discs that count.

    Args:
        models: As of `clearances`.
        qpos: Of the whole model.
        qvel: Likewise.
        place: Indices of the body's first joint in both, and where the body is at qpos = 0, m.
        discs: As of `clearances`, shape (n, 4).
        margin: Kept free of them, m.
    """
    start = np.empty(6)
    for i in range(3):
        start[i], start[3 + i] = qpos[int(place[0]) + i], qvel[int(place[1]) + i]
    start[0] += place[2]
    start[1] += place[3]
    now, loss, farthest, outermost = _motion(start), 0.0, np.zeros(len(discs)), 0.0
    for i in range(len(discs)):
        outermost = max(outermost, abs(discs[i, 3]))
    for model in models:
        body = _body(model)
        control_dt, coast = body.timestep * body.substeps, body.mass / body.damping
        change = body.drive_limit / body.mass * control_dt
        turn = min(control_dt * body.yaw_limit / body.yaw_damping, math.pi)
        speed = _com_speed(body, now)
        rate = max(abs(now.yaw_rate), body.yaw_limit / body.yaw_damping)
        momentum = body.yaw_inertia * rate + abs(body.com_offset) * body.mass * (speed + change)
        angle = control_dt * rate + momentum / body.yaw_damping
        # Full drive instead of full braking, as much turning one way as the other, and what that swings ahead.
        other = change * (control_dt + coast) + speed * (control_dt + turn * coast)
        loss = max(loss, 2.0 * (other + outermost * min(angle, 1.0)))
        pushed = change * (control_dt + coast)
        for i in range(len(discs)):
            swing = 2.0 * abs(discs[i, 3] - body.com_offset)
            farthest[i] = max(farthest[i], reach(body, now, discs[i, 3]) + (pushed + swing))
    gaps, nearest = np.empty(len(discs)), margin
    cos, sin = math.cos(now.heading), math.sin(now.heading)
    for i in range(len(discs)):
        gaps[i] = _gap(discs[i], now.x, now.y, cos, sin)
    if len(discs):
        nearest = max(nearest, gaps.min())
    near = discs[~(gaps - farthest > nearest)]
    brake = brake_control(_body(models[0]), now)
    return Sight(start, brake, near, clearances(models, start, brake, 0.0, near, False), loss)


def way_to_rest(body: HeadingDrive, start: Array) -> Array:
    """Where the body is while it brakes, from a motion on, m, shape (instants, 2)."""
    motion, places = Motion(*start.tolist()), [start[None, :2]]
    while reach(body, motion, 0.0) >= REST_M:
        step = np.empty((body.substeps, 4))
        motion = advance(body, motion, brake_control(body, motion), 0.0, step)
        places.append(step[:, :2])
    return np.concatenate(places)
