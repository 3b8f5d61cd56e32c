"""A planar body driven along its heading: exact prediction of held controls, and its stopping path in closed form.

The body slides in the plane with linear damping and is driven along its heading only. Without drive it coasts to rest
at `p + (m / c) v` in a straight line. With the drive braking along a fixed heading, the forward part stops after `T v
- T v_t log(1 + v / v_t)` (T = m / c, v_t = F_max / c) while the sideways part coasts on to `T v`. The path is convex
and lies in the triangle of p, the crossing of its tangent with the forward stop, and its end. With uncertain mass and
damping the longest stops span a trapezoid. The distance of either from an obstacle never falls while the backup
manoeuvre (brake along the heading, hold the heading) runs. All of this holds for MuJoCo's semi-implicit Euler step
too.

Source: appendix "Relative degree and kinetic stopping insets", for this plant. The functions are compiled.
"""

import math
from typing import NamedTuple

import numpy as np

from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array

_WANDER = 0.012
"""Bound on the lateral deviation of the stopping path, per metre of sideways coasting: drag turns a sliding body.

Measured in MuJoCo: 0.0104 at 1.3 m/s, less at lower speeds.
"""


class Motion(NamedTuple):
    """Position (m), heading (rad), velocity of the turning axis (m/s) and yaw rate (rad/s)."""

    x: float
    y: float
    heading: float
    vx: float
    vy: float
    yaw_rate: float


class StoppingPath(NamedTuple):
    """Area that a braking body stays in, in its heading frame, mirrored so that every number is non-negative.

    Attributes:
        x, y: Position now, m.
        ex, ey: Unit vector of the forward motion (the heading, or its opposite when moving backwards).
        sx, sy: Unit vector of the sideways motion.
        forward: Distance until the forward motion stops, m.
        sideways: Distance that the sideways motion coasts, m.
        crossing: Sideways distance at which the tangent of the motion reaches `forward`, m.
        radius: Of a circle around the present position that contains the area and its wander, m.
        spread: Whether the area is the trapezoid of an uncertain mass or damping.
        wander: Bound on the deviation from the path by drag, m; subtracted from distances.
    """

    x: float
    y: float
    ex: float
    ey: float
    sx: float
    sy: float
    forward: float
    sideways: float
    crossing: float
    radius: float
    spread: bool
    wander: float = 0.0


@compiled
def _to_segment(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> float:
    ux, uy = bx - ax, by - ay
    square = ux * ux + uy * uy
    wx, wy = px - ax, py - ay
    along = (wx * ux + wy * uy) / square if square > 0.0 else 0.0
    along = 0.0 if along < 0.0 else min(along, 1.0)
    return hypot(wx - along * ux, wy - along * uy)


@compiled
def path_distance(path: StoppingPath, px: float, py: float) -> float:
    """Signed distance of a point from the area enlarged by its wander, m: negative inside."""
    dx, dy = px - path.x, py - path.y
    a, b = dx * path.ex + dy * path.ey, dx * path.sx + dy * path.sy
    s, c, e = path.forward, path.crossing, path.sideways
    near = min(_to_segment(a, b, 0.0, 0.0, s, c), _to_segment(a, b, s, c, s, e))
    if path.spread:
        near = min(near, _to_segment(a, b, s, e, 0.0, e), _to_segment(a, b, 0.0, e, 0.0, 0.0))
    else:
        near = min(near, _to_segment(a, b, s, e, 0.0, 0.0))
    above = b * s >= c * a
    below = b <= e if path.spread else b * s <= e * a
    inside = 0.0 <= a <= s and above and below
    return (-near if inside else near) - path.wander


def path_corners(path: StoppingPath) -> Array:
    """Corners of the area without its wander, m: where the body is, and on in its order; the third is its end.

    Shape (3, 2), of a trapezoid (4, 2).
    """
    along, aside = (path.forward, path.forward, 0.0), (path.crossing, path.sideways, path.sideways)
    count = 3 if path.spread else 2
    corners = np.tile(np.array([path.x, path.y]), (count + 1, 1))
    corners[1:] += np.outer(along[:count], (path.ex, path.ey)) + np.outer(aside[:count], (path.sx, path.sy))
    return corners


@compiled
def end_distance(path: StoppingPath, px: float, py: float) -> float:
    """Distance of a point from the rest position, less the wander, m."""
    end_x = path.x + path.forward * path.ex + path.sideways * path.sx
    end_y = path.y + path.forward * path.ey + path.sideways * path.sy
    return hypot(px - end_x, py - end_y) - path.wander


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
        uncertainty: Relative uncertainty of mass and damping each, in [0, 1).
        top_yaw_rate: The most that the actuators reach from rest, rad/s.
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
    uncertainty: float = 0.0
    top_yaw_rate: float = math.inf

    def corners(self) -> "list[HeadingDrive]":
        """The bodies at the corners of the uncertainty, each without uncertainty; this one if there is none."""
        if self.uncertainty == 0.0:
            return [self]
        factors = (1.0 - self.uncertainty, 1.0 + self.uncertainty)
        return [
            self._replace(
                mass=self.mass * m,
                yaw_inertia=self.yaw_inertia * m,
                damping=self.damping * c,
                yaw_damping=self.yaw_damping * c,
                uncertainty=0.0,
            )
            for m in factors
            for c in factors
        ]


@compiled
def brake_distance(body: HeadingDrive, speed: float) -> float:
    """Longest distance to a stop under full braking, m, for a forward speed >= 0 in m/s, inside the uncertainty.

    The last hold brakes just enough to end at rest: at most an eighth of its speed change times the hold more.
    """
    control_dt = body.timestep * body.substeps
    mass, damping = body.mass * (1.0 + body.uncertainty), body.damping * (1.0 - body.uncertainty)
    time, terminal = mass / damping, body.drive_limit / damping
    last = 0.125 * body.drive_limit / mass * control_dt**2
    last = min(last, 0.5 * speed * control_dt)
    return time * (speed - terminal * math.log1p(speed / terminal)) + last


@compiled
def brake_control(body: HeadingDrive, forward_speed: float) -> float:
    """The drive control that brakes fully, or just to rest within one hold."""
    control_dt = body.timestep * body.substeps
    force = -forward_speed * body.mass / control_dt
    return max(-body.drive_limit, min(force, body.drive_limit)) / body.drive_gain


@compiled
def residual_turn_angle(body: HeadingDrive, yaw_rate: float) -> float:
    """Angle by which the body still turns while the servo brakes its rotation, rad.

    Simulated for one control step; the oscillation of the servo about zero is left out.
    """
    h, m_l = body.timestep, body.mass + body.timestep * body.damping
    inertia = body.yaw_inertia + h * body.yaw_damping - (body.mass * body.com_offset) ** 2 / m_l
    rate, angle, full = yaw_rate, 0.0, h * body.yaw_limit / inertia
    for _ in range(body.substeps):
        if abs(rate) <= full:
            break
        torque = max(-body.yaw_limit, min(body.yaw_feedback * rate, body.yaw_limit))
        rate += h * (torque - body.yaw_damping * rate) / inertia
        angle += h * rate
    return angle


@compiled
def stopping_path(body: HeadingDrive, motion: Motion) -> StoppingPath:
    """The area that the backup manoeuvre stays in."""
    heading = motion.heading + residual_turn_angle(body, motion.yaw_rate)
    cos, sin = math.cos(heading), math.sin(heading)
    ahead = motion.vx * cos + motion.vy * sin
    # Sideways the centre of mass coasts, not the turning axis: add the share of the yaw rate.
    aside = motion.vy * cos - motion.vx * sin + body.com_offset * motion.yaw_rate
    flip_a, flip_s = (-1.0 if ahead < 0.0 else 1.0), (-1.0 if aside < 0.0 else 1.0)
    ahead, aside = abs(ahead), abs(aside)
    coast = body.mass * (1.0 + body.uncertainty) / (body.damping * (1.0 - body.uncertainty))
    forward = brake_distance(body, ahead)
    sideways = coast * aside
    wander = _WANDER * sideways
    crossing = min(sideways, forward * aside / ahead) if ahead > 1e-9 else 0.0
    radius = hypot(forward, sideways) + wander
    return StoppingPath(
        motion.x,
        motion.y,
        flip_a * cos,
        flip_a * sin,
        -flip_s * sin,
        flip_s * cos,
        forward,
        sideways,
        crossing,
        radius,
        body.uncertainty > 0.0,
        wander,
    )


@compiled
def com_speed(body: HeadingDrive, motion: Motion) -> float:
    """Speed of the centre of mass, m/s."""
    swing = body.com_offset * motion.yaw_rate
    return hypot(motion.vx - swing * math.sin(motion.heading), motion.vy + swing * math.cos(motion.heading))


@compiled
def beyond_reach(body: HeadingDrive, motion: Motion) -> float:
    """The share by which a motion is faster than the actuators make it from rest; at most 0 for what they reach.

    The force on the centre of mass is the drive less the damping of the axis, which swings about it: its speed stays
    below `F_max / c + r w`. The damping's torque about the axis bounds the yaw rate w: see `top_yaw_rate`.
    """
    slow = body.damping * (1.0 - body.uncertainty)
    top = body.drive_limit / slow + abs(body.com_offset) * body.top_yaw_rate
    return max(com_speed(body, motion) / top, abs(motion.yaw_rate) / body.top_yaw_rate) - 1.0


@compiled
def advance(body: HeadingDrive, motion: Motion, drive: float, turn: float, substeps: int) -> Motion:
    """Motion after so many physics steps of both controls."""
    x, y, heading, vx, vy, yaw_rate = motion
    h, r, m = body.timestep, body.com_offset, body.mass
    push = max(-body.drive_limit, min(body.drive_gain * drive, body.drive_limit))
    along = 1.0 / (m + h * body.damping)
    m_l, m_c, m_w = m + h * body.damping, m * r, body.yaw_inertia + h * body.yaw_damping
    scale = h / (m_l * m_w - m_c * m_c)
    limit, damping, yaw_damping = body.yaw_limit, body.damping, body.yaw_damping
    wanted, feedback = body.yaw_gain * turn, body.yaw_feedback
    for _ in range(substeps):
        cos, sin = math.cos(heading), math.sin(heading)
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
        heading += h * yaw_rate
    return Motion(x, y, heading, vx, vy, yaw_rate)


@compiled
def predict(body: HeadingDrive, motion: Motion, drive: float, turn: float) -> Motion:
    """Motion after both controls were held for one control step, by semi-implicit Euler steps as in MuJoCo."""
    return advance(body, motion, drive, turn, body.substeps)
