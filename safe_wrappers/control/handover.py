"""The handover from one stream of held commands to the next: blends, and whether a machine bears them.

A stream is a policy's commands for the next control steps, shape (n, m): one per step, in action units. A machine's
own limits are judged along the curve that a drive follows which interpolates the commands: matched ends say nothing
about what lies between them.

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import Array, ConfigurationError, positive

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

LOOK_BACK: Final = 3
"""Commands before a seam that its blend continues: position, first and second difference."""
SMOOTHSTEP_PEAKS: Final = (1.0, 1.875, 10.0 / math.sqrt(3.0), 60.0)
"""Largest magnitude of the smoothstep and its derivatives."""
_ROUND_UP: Final = 1.0 + 1e-12
"""Blend times are lengthened by this factor, so that rounding never makes them too short."""
_ROUNDING: Final = 1.0 + 1e-9
"""Limits count as kept up to this factor."""


def smoothstep(s: ArrayLike) -> Array:
    """alpha(s) = 6 s^5 - 15 s^4 + 10 s^3 for s in [0, 1], 0 before it and 1 after it, of any shape."""
    s = np.clip(np.asarray(s, dtype=np.float64), 0.0, 1.0)
    near = np.minimum(s, 1.0 - s)  # alpha(1 - s) = 1 - alpha(s): the half without cancellation
    half = near**3 * (near * (6.0 * near - 15.0) + 10.0)
    return np.asarray(np.where(s <= 0.5, half, 1.0 - half))


class Fade:
    """A smoothstep of so many `steps` from a command that is latched, shape (m,), to those that are given to it."""

    def __init__(self, latched: Any = None, steps: int = 0) -> None:
        self._latched, self._steps, self._done = latched, steps, 0

    @property
    def over(self) -> bool:
        """Whether it does nothing any more."""
        return self._done >= self._steps

    def __call__(self, control: Array) -> Array:
        """The next command, between the two, shape (m,); the given one itself when it is over."""
        if self.over:
            return control
        self._done += 1
        weight = float(smoothstep(self._done / (self._steps + 1.0)))
        return np.asarray(self._latched * (1.0 - weight) + weight * control)


def shortest_blend(change: Array | float, limit: Array | float, derivative: int = 1) -> Array:
    """Shortest smoothstep, s, between two constant commands under a limit on a derivative by time (1 to 3).

    `(peak |change| / limit)^(1 / derivative)`, rounded up; the limit is in action units per s^derivative.
    """
    time = (SMOOTHSTEP_PEAKS[derivative] * np.abs(change) / limit) ** (1.0 / derivative)
    return np.asarray(time * _ROUND_UP)


def join(
    sent: Array, prior: Array, new: Array, step: Array | float = np.inf, fewest: int = 0
) -> tuple[Array, int]:
    """The shortest blend from what was sent into a new stream in which neighbours differ by at most `step`.

    Streams are mixed by the smoothstep, the prior one held at the last command unless it lasts for the whole blend.
    If no blend that ends inside the new stream keeps the step, it is the one that exceeds it least.

    Args:
        sent: The latest commands, oldest first, shape (k, m), k >= 0; with none there is no seam.
        prior: Remaining commands of the present stream, shape (p, m), p >= 0.
        new: The new stream for the next steps, shape (n, m), n >= 1.
        step: Action units, of every component, or of each, shape (m,).
        fewest: Least number of control steps of the blend (fewer only if the new stream is shorter).

    Returns:
        The commands from the seam on, shape (n, m), the blend and then the new stream bit for bit; the blend's steps.
    """
    found, least = (new, 0), np.inf
    if not len(sent):
        return found
    first = min(fewest, len(new) - 1)
    if first == 0 and len(new) > 1 and (np.abs(new[0] - sent[-1]) > step).any():
        first = 1
    for steps in range(first, len(new)):
        before = prior[:steps] if steps <= len(prior) else sent[-1]
        mixed = before + smoothstep(np.arange(1.0, steps + 1.0) / (steps + 1.0))[:, None] * (
            new[:steps] - before
        )
        plan = np.concatenate([mixed, new[steps:]])
        peak = float((np.abs(_way(sent, plan, steps)) / step).max())
        if peak < least:
            found, least = (plan, steps), peak
        if peak <= 1.0:
            break
    return found


def _way(sent: Array, plan: Array, steps: int) -> Array:
    """Differences of neighbouring commands from the last one sent to the first one after a blend, (steps + 1, m)."""
    return np.diff(np.concatenate([sent[-1:], plan[: steps + 1]]), axis=0)


def bridge(sent: Array, new: Array, steps: int, control_dt: float) -> PPoly:
    """The quintic that bridges `steps` commands: of the time since the last command, s, values (m,).

    It goes from the last of `sent` (k, m) to entry `steps` of `new` (n, m), where first and second derivatives match.
    """
    from scipy.interpolate import BPoly, PPoly

    per_step, none = control_dt ** -np.arange(3.0)[:, None], np.zeros_like(sent[-1])
    # Backward differences of what was sent, 0 where too little was; central ones of the stream.
    before = [np.diff(sent[-k - 1 :], n=k, axis=0)[0] if len(sent) > k else none for k in range(LOOK_BACK)]
    slope = np.gradient(new, axis=0)[steps] if len(new) > 1 else none
    bend = np.diff(new[steps - 1 : steps + 2], n=2, axis=0)[0] if 0 < steps < len(new) - 1 else none
    ends = [np.stack(before) * per_step, np.stack([new[steps], slope, bend]) * per_step]
    bernstein = BPoly.from_derivatives([0.0, (steps + 1) * control_dt], ends)
    return PPoly.from_bernstein_basis(bernstein)


def _extremes(curve: PPoly, derivative: int) -> list[Array]:
    """For each component the times at which a derivative by time may be extreme between the ends."""
    found = curve.derivative(derivative + 1).roots(discontinuity=False, extrapolate=False)
    return [times[np.isfinite(times)] for times in found]


def peaks(curve: PPoly, derivative: int) -> Array:
    """Largest magnitude of a derivative by time (0 to 3) over a whole curve, shape (m,): at its ends or extremes."""
    times = [np.concatenate([curve.x, inner]) for inner in _extremes(curve, derivative)]
    return np.array([np.abs(curve(t, derivative)[:, j]).max() for j, t in enumerate(times)])


def hermite_spline(positions: Array, spacing: float) -> PPoly:
    """The cubic Hermite spline through positions (k, m), `spacing` apart, with central differences as rates."""
    from scipy.interpolate import CubicHermiteSpline

    rates = np.gradient(positions, spacing, axis=0)
    return CubicHermiteSpline(spacing * np.arange(len(positions)), positions, rates)


def knot_torque_step(inertia: Array, spacing: float, positions: Array) -> Array:
    """Torque steps M(q) dq'' at the inner knots of `hermite_spline`, N m, shape (k - 2, m), for M (k - 2, m, m)."""
    bend = hermite_spline(positions, spacing).derivative(2)
    at_starts, at_ends = bend.c[-1], np.polyval(bend.c, spacing)
    jumps = at_starts[1:] - at_ends[:-1]
    return np.asarray((inertia @ jumps[:, :, None])[:, :, 0])


_UNITS: Final = {
    "velocity": "action units per s",
    "acceleration": "action units per s^2",
    "jerk": "action units per s^3",
    "torque": "N m",
    "torque_slew": "N m/s",
}


@dataclass(frozen=True)
class SeamLimits:
    """What a machine was measured to bear, for `ChunkHandover(limits=)`; what is None is not judged.

    Each is one number for all entries of a command, or one for each of them, positive. Torques are for commands that
    are positions of joints: those which the joints need, by inverse dynamics of the env's MuJoCo model.
    """

    velocity: float | Sequence[float] | None = None  #: action units per s
    acceleration: float | Sequence[float] | None = None  #: action units per s^2
    jerk: float | Sequence[float] | None = None  #: action units per s^3
    torque: float | Sequence[float] | None = None  #: N m
    torque_slew: float | Sequence[float] | None = None  #: N m/s
    #: For commands that are lengths of MuJoCo's actuators: refuse chunks whose end the measured machine cannot reach
    #: in time, by velocity and acceleration alone, to pass it ("moving") or to stand there ("rest").
    arrival: str | None = None


def limit_of_each(name: str, value: Any, controls: int, unit: str) -> Array:
    """A limit for each entry of a command, shape (controls,), from one number or one for each; infinite for None."""
    if value is None:
        return np.full(controls, np.inf)
    each = [positive(name, one, unit) for one in np.ravel(value)]
    if len(each) not in (1, controls):
        wanted = f"one number, or one for each of the {controls} action components"
        raise ConfigurationError(f"{name} is {wanted}; got {value!r}")
    return np.array(np.broadcast_to(each, controls))


class SeamCheck:
    """Quintic blends of m controls that keep a machine's limits, and whether its chunks do.

    Where torques are limited, `dynamics` has methods `torques` of positions, velocities and accelerations of the
    joints, all of shape (k, m), N m, and `inertia` of their positions, shape (k, m, m), kg m^2.

    Attributes:
        bounds: Of velocity, acceleration and jerk, shape (m,) each.
    """

    def __init__(self, limits: SeamLimits, controls: int, control_dt: float, dynamics: Any = None) -> None:
        self._control_dt, self._dynamics = control_dt, dynamics
        *self.bounds, self._torque, self._slew = (
            limit_of_each(f"limits.{name}", getattr(limits, name), controls, unit)
            for name, unit in _UNITS.items()
        )

    def join(
        self, sent: Array, new: Array, step: Array, fewest: int, low: Array, high: Array
    ) -> tuple[Array, int] | None:
        """As `join`, but by quintics, and None if none will do, which keeps step, limits and box (m,)."""
        if not len(sent):
            return new, 0
        for steps in range(min(fewest, len(new) - 1), len(new)):
            curve = bridge(sent, new, steps, self._control_dt)
            made = curve(self._control_dt * np.arange(1.0, steps + 1.0))
            plan = np.concatenate([np.clip(made, low, high), new[steps:]])
            cut = not np.allclose(made, plan[:steps], rtol=1e-9, atol=1e-12)
            if not cut and (np.abs(_way(sent, plan, steps)) <= step).all() and self.accepts(curve):
                return plan, steps
        return None

    def accepts(self, curve: PPoly) -> bool:
        """Whether a blend keeps all limits up to its end.

        Torques are judged at every quarter of a control step, and where an acceleration is largest or smallest.
        """
        if any((peaks(curve, d) > bound * _ROUNDING).any() for d, bound in enumerate(self.bounds, 1)):
            return False
        if self._dynamics is None:
            return True
        quarters = round(4.0 * curve.x[-1] / self._control_dt)
        times = np.unique(np.concatenate([np.linspace(0.0, curve.x[-1], quarters + 1), *_extremes(curve, 2)]))
        torque, passed = self._dynamics.torques(*(curve(times, d) for d in range(3))), np.diff(times)[:, None]
        within = np.where(passed > 1e-9 * self._control_dt, passed, self._control_dt)
        slow = np.abs(np.diff(torque, axis=0)) <= self._slew * within * _ROUNDING
        return bool((np.abs(torque) <= self._torque * _ROUNDING).all() and slow.all())

    def bears_knots(self, knots: Array, spacing: float) -> bool:
        """Whether torque steps at the knots (k, m) of a cubic spline, `spacing` s apart, keep the torque's slew."""
        if self._dynamics is None or len(knots) < 3:
            return True
        steps = knot_torque_step(self._dynamics.inertia(knots[1:-1]), spacing, knots)
        return bool((self._slew * self._control_dt * _ROUNDING >= np.abs(steps)).all())
