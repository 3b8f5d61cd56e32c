"""A planar body driven along its heading: exact prediction of held controls, and its stopping path in closed form.

The body slides in the plane with linear damping and is driven along its heading only. Without drive it coasts to rest
at `p + (m / c) v` in a straight line. With the drive braking along a fixed heading, the forward part stops after `T v
- T v_t log(1 + v / v_t)` (T = m / c, v_t = F_max / c) while the sideways part coasts on to `T v`. The path is convex
and lies in the triangle of p, the crossing of its tangent with the forward stop, and its end. With uncertain mass and
damping the longest stops span a trapezoid. The distance of either from an obstacle never falls while the backup
manoeuvre (brake along the heading, hold the heading) runs. All of this holds for MuJoCo's semi-implicit Euler step
too.

Source: appendix "Relative degree and kinetic stopping insets", for this plant. Plain floats: at this size they are
faster than arrays.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

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

    def distance(self, px: float, py: float) -> float:
        """Signed distance of a point from the area enlarged by its wander, m: negative inside."""
        dx, dy = px - self.x, py - self.y
        a, b = dx * self.ex + dy * self.ey, dx * self.sx + dy * self.sy
        s, c, e = self.forward, self.crossing, self.sideways
        near = _to_segment(a, b, 0.0, 0.0, s, c)
        near = min(near, _to_segment(a, b, s, c, s, e))
        if self.spread:
            near = min(near, _to_segment(a, b, s, e, 0.0, e), _to_segment(a, b, 0.0, e, 0.0, 0.0))
        else:
            near = min(near, _to_segment(a, b, s, e, 0.0, 0.0))
        above = b * s >= c * a
        below = b <= e if self.spread else b * s <= e * a
        inside = 0.0 <= a <= s and above and below
        return (-near if inside else near) - self.wander

    def end_distance(self, px: float, py: float) -> float:
        """Distance of a point from the rest position, less the wander, m."""
        end_x = self.x + self.forward * self.ex + self.sideways * self.sx
        end_y = self.y + self.forward * self.ey + self.sideways * self.sy
        return math.hypot(px - end_x, py - end_y) - self.wander


def _to_segment(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> float:
    ux, uy = bx - ax, by - ay
    square = ux * ux + uy * uy
    wx, wy = px - ax, py - ay
    along = (wx * ux + wy * uy) / square if square > 0.0 else 0.0
    along = 0.0 if along < 0.0 else min(along, 1.0)
    return math.hypot(wx - along * ux, wy - along * uy)


@dataclass(frozen=True, slots=True)
class HeadingDrive:
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

    @property
    def control_dt(self) -> float:
        """Control interval, s."""
        return self.timestep * self.substeps

    @property
    def coast_time(self) -> float:
        """Longest time constant of coasting, m / c, inside the uncertainty, s: coasting distance per speed."""
        return self.mass * (1.0 + self.uncertainty) / (self.damping * (1.0 - self.uncertainty))

    @property
    def top_speed(self) -> float:
        """Smallest terminal speed under full drive inside the uncertainty, m/s."""
        return self.drive_limit / (self.damping * (1.0 + self.uncertainty))

    @property
    def fastest_change(self) -> float:
        """Largest change of speed in one control step inside the uncertainty, m/s."""
        return self.drive_limit / (self.mass * (1.0 - self.uncertainty)) * self.control_dt

    def corners(self) -> "list[HeadingDrive]":
        """The bodies at the corners of the uncertainty, each without uncertainty; this one if there is none."""
        if self.uncertainty == 0.0:
            return [self]
        factors = (1.0 - self.uncertainty, 1.0 + self.uncertainty)
        return [
            replace(
                self,
                mass=self.mass * m,
                yaw_inertia=self.yaw_inertia * m,
                damping=self.damping * c,
                yaw_damping=self.yaw_damping * c,
                uncertainty=0.0,
            )
            for m in factors
            for c in factors
        ]

    def brake_distance(self, speed: float) -> float:
        """Longest distance to a stop under full braking, m, for a forward speed >= 0 in m/s, inside the uncertainty.

        The last hold brakes just enough to end at rest: at most an eighth of its speed change times the hold more.
        """
        mass, damping = self.mass * (1.0 + self.uncertainty), self.damping * (1.0 - self.uncertainty)
        time, terminal = mass / damping, self.drive_limit / damping
        last = 0.125 * self.drive_limit / mass * self.control_dt**2
        last = min(last, 0.5 * speed * self.control_dt)
        return time * (speed - terminal * math.log1p(speed / terminal)) + last

    def brake_control(self, forward_speed: float) -> float:
        """The drive control that brakes fully, or just to rest within one hold."""
        force = -forward_speed * self.mass / self.control_dt
        return max(-self.drive_limit, min(force, self.drive_limit)) / self.drive_gain

    def residual_turn_angle(self, yaw_rate: float) -> float:
        """Angle by which the body still turns while the servo brakes its rotation, rad.

        Simulated for one control step; the oscillation of the servo about zero is left out.
        """
        h, m_l = self.timestep, self.mass + self.timestep * self.damping
        inertia = self.yaw_inertia + h * self.yaw_damping - (self.mass * self.com_offset) ** 2 / m_l
        rate, angle, full = yaw_rate, 0.0, h * self.yaw_limit / inertia
        for _ in range(self.substeps):
            if abs(rate) <= full:
                break
            torque = max(-self.yaw_limit, min(self.yaw_feedback * rate, self.yaw_limit))
            rate += h * (torque - self.yaw_damping * rate) / inertia
            angle += h * rate
        return angle

    def stopping_path(self, motion: Motion, brake: bool = True) -> StoppingPath:
        """The area that the backup manoeuvre stays in; `brake=False`: coasting along the heading too."""
        heading = motion.heading + self.residual_turn_angle(motion.yaw_rate)
        cos, sin = math.cos(heading), math.sin(heading)
        ahead = motion.vx * cos + motion.vy * sin
        # Sideways the centre of mass coasts, not the turning axis: add the share of the yaw rate.
        aside = motion.vy * cos - motion.vx * sin + self.com_offset * motion.yaw_rate
        flip_a, flip_s = (-1.0 if ahead < 0.0 else 1.0), (-1.0 if aside < 0.0 else 1.0)
        ahead, aside = abs(ahead), abs(aside)
        coast = self.coast_time
        forward = self.brake_distance(ahead) if brake else coast * ahead
        sideways = coast * aside
        wander = _WANDER * sideways
        crossing = min(sideways, forward * aside / ahead) if ahead > 1e-9 else 0.0
        radius = math.hypot(forward, sideways) + wander
        place = (motion.x, motion.y, flip_a * cos, flip_a * sin, -flip_s * sin, flip_s * cos)
        return StoppingPath(*place, forward, sideways, crossing, radius, self.uncertainty > 0.0, wander)

    def predict(self, motion: Motion, drive: float, turn: float) -> Motion:
        """Motion after both controls were held for one control step, by semi-implicit Euler steps as in MuJoCo."""
        x, y, heading, vx, vy, yaw_rate = motion
        h, r, m = self.timestep, self.com_offset, self.mass
        push = max(-self.drive_limit, min(self.drive_gain * drive, self.drive_limit))
        along = 1.0 / (m + h * self.damping)
        m_l, m_c, m_w = m + h * self.damping, m * r, self.yaw_inertia + h * self.yaw_damping
        scale = h / (m_l * m_w - m_c * m_c)
        limit, damping, yaw_damping = self.yaw_limit, self.damping, self.yaw_damping
        wanted, feedback = self.yaw_gain * turn, self.yaw_feedback
        for _ in range(self.substeps):
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
