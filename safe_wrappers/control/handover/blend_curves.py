"""The blend of a seam as a curve between the commands: polynomials of time, one after the other.

Commands are held, so the curve is what a drive follows that interpolates them. A bridge is its own polynomial. A
smoothstep mixes two streams, which are taken as cubic Hermite splines through their commands; one that is no longer
than a control step is the cubic between its ends.

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

import math
from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.interior import interior_extrema
from safe_wrappers.control.handover.seams import Blend, backward_differences, stream_derivatives
from safe_wrappers.control.handover.splines import (
    differentiate,
    hermite_coefficients,
    quintic_coefficients,
    value,
)

_SMOOTHSTEP = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])


class Motion(NamedTuple):
    """Along a curve, in the order of time; at a junction twice, before and after."""

    times: Array  # shape (k,), s
    position: Array  # shape (k, m), action units
    velocity: Array  # per s
    acceleration: Array  # per s^2


class BlendCurve(NamedTuple):
    """From the last command to where the new stream goes on bit for bit."""

    pieces: Array  # coefficients, lowest power of t first, shape (p, m, n), by the time since the piece's start, s
    span: float  # duration of each piece, s
    before: Array  # position and its first and second derivative where the curve begins, shape (3, m)
    after: Array  # the same of the new stream where it ends
    control_dt: float

    @classmethod
    def of(
        cls, blend: Blend, sent: Array, prior: Array, new: Array, steps: int, control_dt: float
    ) -> "BlendCurve":
        """The curve of a blend of `seams.join` that mixes `steps` commands; its arguments."""
        per_step = control_dt ** -np.arange(3.0)[:, None]
        before = np.stack(backward_differences(sent, 3)) * per_step
        after = np.stack([d[steps] for d in stream_derivatives(new)]) * per_step
        if blend == "smoothstep" and steps > 0:
            pieces = _mixed(sent, prior, new, steps) / control_dt ** np.arange(9.0)
            return cls(pieces, control_dt, before, after, control_dt)
        span = (steps + 1) * control_dt
        q0, v0, a0 = before
        q1, v1, a1 = after
        if blend == "quintic":
            bridge = quintic_coefficients(q0, v0, a0, q1, v1, a1, span)
        else:
            bridge = hermite_coefficients(q0, v0, q1, v1, span)
        return cls(bridge[None], span, before, after, control_dt)

    def peak(self, derivative: int) -> Array:
        """Largest magnitude of a derivative (0 to 3) by time over the whole curve, shape (m,).

        Where a lower derivative jumps, at a junction or an end, it does so within one control interval.
        """
        most = interior_extrema(self.pieces, self.span, derivative).peak.max(axis=0)
        for lower in range(1, derivative):
            below = differentiate(self.pieces, lower)
            gone = np.concatenate([self.before[None, lower], value(below, self.span)])
            come = np.concatenate([value(below, 0.0), self.after[None, lower]])
            jump = np.abs(come - gone).max(axis=0)
            most = np.maximum(most, jump / self.control_dt ** (derivative - lower))
        return np.asarray(most)

    def motion(self) -> Motion:
        """At every quarter of a control step, and where an acceleration is largest or smallest inside of a piece."""
        extreme = interior_extrema(self.pieces, self.span, 2)
        grid = np.linspace(0.0, self.span, 4 * round(self.span / self.control_dt) + 1)
        seen = [(0.0, *self.before)]
        for i, piece in enumerate(self.pieces):
            for t in np.unique(np.concatenate([grid, extreme.minimum_at[i], extreme.maximum_at[i]])):
                seen.append((i * self.span + t, *(value(differentiate(piece, k), t) for k in range(3))))
        seen.append((len(self.pieces) * self.span, *self.after))
        times, *moved = zip(*seen, strict=True)
        return Motion(np.array(times), *(np.array(each) for each in moved))


def _mixed(sent: Array, prior: Array, new: Array, steps: int) -> Array:
    """A smoothstep's pieces, one for each control step, by time in control steps; shape (steps + 1, m, 9)."""
    moving = steps <= len(prior)
    if moving:
        old = np.concatenate([sent[-1:], prior[: steps + 1]])
        if len(old) < steps + 2:  # the last of them weighs nothing
            old = np.concatenate([old, 2.0 * old[-1:] - old[-2:-1]])
        rates = np.gradient(old, axis=0)
        rates[0] = backward_differences(sent, 2)[1]
    else:
        old = np.broadcast_to(sent[-1], (steps + 2, sent.shape[1]))
        rates = np.zeros_like(old)
    fresh_rates = stream_derivatives(new)[1][: steps + 1]
    fresh = np.concatenate([new[:1] - fresh_rates[:1], new[: steps + 1]])
    fresh_rates = np.concatenate([fresh_rates[:1], fresh_rates])
    one = np.ones(())
    olds = hermite_coefficients(old[:-1], rates[:-1], old[1:], rates[1:], one)
    differences = hermite_coefficients(fresh[:-1], fresh_rates[:-1], fresh[1:], fresh_rates[1:], one) - olds
    # Taylor's series of the weight at the start of every control step.
    phases, step = np.arange(steps + 1.0) / (steps + 1.0), 1.0 / (steps + 1.0)
    pieces = np.concatenate([olds, np.zeros((*olds.shape[:-1], 5))], axis=-1)
    for power in range(6):
        weight = value(differentiate(_SMOOTHSTEP, power), phases) * step**power / math.factorial(power)
        pieces[..., power : power + 4] += weight[:, None, None] * differences
    return pieces
