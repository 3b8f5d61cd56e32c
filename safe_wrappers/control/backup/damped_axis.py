"""One axis of a damped point mass under a held force: exact step, stopping distance and its inverse.

A physics step maps speed v and control u to `v' = decay v + gain u` and moves by `timestep v'` (MuJoCo's
semi-implicit Euler step with implicit joint damping). A control is held for `substeps` of them, so a hold is linear:
`v_end = A v + B u`, `x_end = x + P v + Q u`. Braking is the full opposing control, and in the last hold `-A v / B`,
which ends at rest. The stopping distance is piecewise linear in v: a knot at each speed that n full holds remove.
"""

import bisect
import math
from dataclasses import dataclass, field

_MOST_HOLDS = 4096
"""Length of the table, in holds of full braking; the distance beyond it is infinite."""
_FLAT = 1e9
"""m/s; end of the constant part of the table above the clip."""


@dataclass(frozen=True)
class _Stops:
    """Stopping distances for one direction of motion."""

    speeds: list[float]  # the knots, m/s, ascending from 0
    ways: list[float]  # stopping distance at each knot, m
    totals: list[float]  # with the part of the hold before that is proportional to the speed, m

    def way(self, speed: float) -> float:
        """Stopping distance from a speed >= 0, m; infinite beyond the table."""
        return _interpolate(self.speeds, self.ways, speed)

    def speed(self, total: float) -> float:
        """The inverse of `totals`; the largest tabulated speed beyond it."""
        if total >= self.totals[-1]:
            return self.speeds[-1]
        return _interpolate(self.totals, self.speeds, total)


def _interpolate(xs: list[float], ys: list[float], x: float) -> float:
    i = bisect.bisect_right(xs, x)
    if i == len(xs):
        return ys[-1] if x == xs[-1] else math.inf
    before = xs[i - 1]
    return ys[i - 1] + (x - before) / (xs[i] - before) * (ys[i] - ys[i - 1])


@dataclass(frozen=True)
class DampedAxis:
    """Constants of one axis.

    Attributes:
        decay: Share of the speed that one physics step keeps without control, in (0, 1].
        gain: Speed that one physics step adds per control, m/s, > 0.
        timestep: Physics step, s.
        substeps: Physics steps per control step.
        low: Smallest control, < 0.
        high: Largest control, > 0.
        clip: Speed to which the env clips the motion at the start of every control step, m/s; inf for none.
    """

    decay: float
    gain: float
    timestep: float
    substeps: int
    low: float
    high: float
    clip: float = math.inf

    keep: float = field(init=False)  # A: share of the speed that one hold keeps
    add: float = field(init=False)  # B: speed that one hold adds per control, m/s
    drift: float = field(init=False)  # P: displacement in one hold per speed, s
    shift: float = field(init=False)  # Q: displacement in one hold per control, m
    _up: _Stops = field(init=False, repr=False)
    _down: _Stops = field(init=False, repr=False)

    def __post_init__(self) -> None:
        keep, add, drift, shift = 1.0, 0.0, 0.0, 0.0
        for _ in range(self.substeps):
            keep, add = self.decay * keep, self.decay * add + self.gain
            drift, shift = drift + self.timestep * keep, shift + self.timestep * add
        fields = {"keep": keep, "add": add, "drift": drift, "shift": shift}
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_up", self._table(-self.low))
        object.__setattr__(self, "_down", self._table(self.high))

    def _table(self, brake: float) -> _Stops:
        """The table for one direction of motion, up to the clip or to `_MOST_HOLDS` knots."""
        loss, lost_way = self.add * brake, self.shift * brake
        # Displacement of the last hold, per speed.
        just_stops = self.drift - self.shift * self.keep / self.add
        speeds, ways = [0.0, loss / self.keep], [0.0, just_stops * loss / self.keep]
        while len(speeds) < _MOST_HOLDS and speeds[-1] < self.clip:
            speed = (speeds[-1] + loss) / self.keep
            ways.append(self.drift * speed - lost_way + ways[-1])
            speeds.append(speed)
        if speeds[-1] >= self.clip:
            ways[-1] = _interpolate(speeds, ways, self.clip)
            speeds[-1] = self.clip
            speeds.append(_FLAT)
            ways.append(ways[-1])
        per_speed = self.shift / self.add
        return _Stops(speeds, ways, [per_speed * v + w for v, w in zip(speeds, ways, strict=True)])

    def clipped(self, v: float) -> float:
        """The speed after the env's clip."""
        return max(-self.clip, min(v, self.clip))

    def step(self, x: float, v: float, u: float) -> tuple[float, float]:
        """Position and speed at the end of a hold; `v` is already clipped."""
        u = max(self.low, min(u, self.high))
        return x + self.drift * v + self.shift * u, self.keep * v + self.add * u

    def rest(self, x: float, v: float) -> float:
        """Position at which braking comes to rest."""
        return x + self._up.way(v) if v >= 0.0 else x - self._down.way(-v)

    def brake(self, v: float) -> float:
        """The control that brakes fully, or just to rest within one hold."""
        return max(self.low, min(-self.keep * self.clipped(v) / self.add, self.high))

    def braking(self, x: float, v: float) -> list[float]:
        """Positions at the ends of the holds of the braking manoeuvre, the present one first, rest last."""
        v = self.clipped(v)
        end, brake = self.rest(x, v), self.low if v >= 0.0 else self.high
        drift, shift, keep, loss = self.drift, self.shift * brake, self.keep, self.add * brake
        last, direction = abs(loss) / keep, 1.0 if v >= 0.0 else -1.0
        points = [x]
        while direction * v > last:
            x, v = x + drift * v + shift, keep * v + loss
            points.append(x)
        if x != end:
            points.append(end)
        return points

    def extent(self, x: float, v: float, u: float) -> tuple[float, float]:
        """Least and greatest position during a hold, its start included; `v` is already clipped."""
        end, speed = self.step(x, v, u)
        if self.substeps == 1 or v * speed >= 0.0:
            return min(x, end), max(x, end)
        u = max(self.low, min(u, self.high))
        least = most = x
        for _ in range(self.substeps):
            v = self.decay * v + self.gain * u
            x += self.timestep * v
            least, most = min(least, x), max(most, x)
        return least, most

    def control_to_rest_at(self, x: float, v: float, target: float) -> float:
        """The control whose hold, and braking after it, comes to rest at `target`; it may be out of bounds.

        The rest point grows with the control. `v` is already clipped.
        """
        per_speed = self.shift / self.add
        way = target - x - (self.drift - per_speed * self.keep) * v
        end = self._up.speed(way) if way >= 0.0 else -self._down.speed(-way)
        return (end - self.keep * v) / self.add
