"""The blend of a seam as a curve between the commands, and what it does between and at its ends.

Commands are held, so the curve is what a drive follows that interpolates them. A quintic is its own polynomial.
A smoothstep mixes two streams, which are taken as cubic Hermite splines through their commands; one that is no longer
than a control step is the cubic between its ends. Polynomials, their roots and splines are SciPy's.

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.seams import Blend, backward_differences, stream_derivatives

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

_SMOOTHSTEP = np.array([6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
"""Coefficients of the smoothstep, highest power first."""


class Motion(NamedTuple):
    """Along a curve, in the order of time; at a junction twice, before and after."""

    times: Array  # shape (k,), s
    position: Array  # shape (k, m), action units
    velocity: Array  # per s
    acceleration: Array  # per s^2


class BlendCurve(NamedTuple):
    """From the last command to where the new stream goes on bit for bit."""

    curve: PPoly  # of the time since the last command, s; values of shape (m,)
    before: Array  # position and its first and second derivative where the curve begins, shape (3, m)
    after: Array  # the same of the new stream where it ends
    control_dt: float

    @classmethod
    def of(
        cls, blend: Blend, sent: Array, prior: Array, new: Array, steps: int, control_dt: float
    ) -> BlendCurve:
        """The curve of a blend of `seams.join` that mixes `steps` commands; its arguments."""
        from scipy.interpolate import BPoly, PPoly  # here: SciPy takes a while to import

        per_step = control_dt ** -np.arange(3.0)[:, None]
        before = np.stack(backward_differences(sent, 3)) * per_step
        after = np.stack([d[steps] for d in stream_derivatives(new)]) * per_step
        if blend == "smoothstep" and steps > 0:
            scale = control_dt ** np.arange(8.0, -1.0, -1.0)[:, None, None]
            pieces = _mixed(sent, prior, new, steps) / scale
            curve = PPoly(pieces, control_dt * np.arange(steps + 2.0))
        else:
            known = 3 if blend == "quintic" else 2
            ends = [0.0, (steps + 1) * control_dt]
            curve = PPoly.from_bernstein_basis(BPoly.from_derivatives(ends, [before[:known], after[:known]]))
        return cls(curve, before, after, control_dt)

    def peak(self, derivative: int) -> Array:
        """Largest magnitude of a derivative (0 to 3) by time over the whole curve, shape (m,).

        Not a search over samples: a polynomial is extreme at its ends or where its derivative is zero. Where a lower
        derivative jumps, at a junction or an end, it does so within one control interval.
        """
        f = _derivative(self.curve, derivative)
        most = np.maximum(np.abs(_at_starts(f)), np.abs(_at_ends(f))).max(axis=0)
        for j, times in enumerate(_extremes(self.curve, derivative)):
            most[j] = max(most[j], float(np.abs(f(times)[:, j]).max(initial=0.0)))
        for lower in range(1, derivative):
            below = _derivative(self.curve, lower)
            gone = np.concatenate([self.before[None, lower], _at_ends(below)])
            come = np.concatenate([_at_starts(below), self.after[None, lower]])
            jump = np.abs(come - gone).max(axis=0)
            most = np.maximum(most, jump / self.control_dt ** (derivative - lower))
        return np.asarray(most)

    def motion(self) -> Motion:
        """At every quarter of a control step, and where an acceleration is largest or smallest inside of a piece."""
        knots = self.curve.x
        grid = np.linspace(0.0, knots[-1], 4 * round(knots[-1] / self.control_dt) + 1)
        inner = np.concatenate([grid, *_extremes(self.curve, 2)])
        seen = [(0.0, *self.before)]
        for i, (start, end) in enumerate(pairwise(knots)):
            inside = inner[(inner > start) & (inner < end)]
            for t in (start, *np.unique(inside), end):
                state = (np.polyval(_derivative(self.curve, k).c[:, i], t - start) for k in range(3))
                seen.append((t, *state))
        seen.append((float(knots[-1]), *self.after))
        times, *moved = zip(*seen, strict=True)
        return Motion(np.array(times), *(np.array(each) for each in moved))


def knot_torque_step(inertia: Array, spacing: float, positions: Array) -> Array:
    """Torque steps M(q) dq'' at the inner knots of the cubic Hermite spline through positions, N m, shape (k - 2, m).

    They are to be held against the torque-slew limit.

    Args:
        inertia: Matrices M, one per inner knot, shape (k - 2, m, m), kg m^2.
        spacing: From one knot to the next, s.
        positions: Shape (k, m), rad; rates at the knots are central differences.
    """
    bend = _derivative(hermite_spline(positions, spacing), 2)
    jumps = _at_starts(bend)[1:] - _at_ends(bend)[:-1]
    return np.asarray((inertia @ jumps[:, :, None])[:, :, 0])


def hermite_spline(positions: Array, spacing: float) -> PPoly:
    """The cubic Hermite spline through positions (k, m), `spacing` apart, with central differences as rates."""
    from scipy.interpolate import CubicHermiteSpline

    rates = np.gradient(positions, spacing, axis=0)
    return CubicHermiteSpline(spacing * np.arange(len(positions)), positions, rates)


def _derivative(curve: PPoly, order: int) -> Any:
    return curve.derivative(order) if order else curve


def _at_starts(curve: PPoly) -> Array:
    """At the start of each piece, shape (pieces, m)."""
    return np.asarray(curve.c[-1])


def _at_ends(curve: PPoly) -> Array:
    """At the end of each piece, by itself, shape (pieces, m)."""
    return np.asarray(np.polyval(curve.c, np.diff(curve.x)[:, None]))


def _extremes(curve: PPoly, derivative: int) -> list[Array]:
    """For each component the times at which a derivative may be extreme inside of pieces."""
    slope = curve.derivative(derivative + 1)
    found = []
    for j in range(slope.c.shape[2]):
        roots = type(curve).construct_fast(slope.c[:, :, j].copy(), slope.x, False)
        times = roots.roots(discontinuity=False)
        found.append(times[np.isfinite(times)])
    return found


def _mixed(sent: Array, prior: Array, new: Array, steps: int) -> Array:
    """A smoothstep's pieces, one for each control step, by time in control steps; shape (9, steps + 1, m)."""
    if steps <= len(prior):
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
    olds = _cubics(old, rates)
    differences = _cubics(fresh, fresh_rates) - olds
    pieces = np.concatenate([np.zeros((5, *olds.shape[1:])), olds])
    # Taylor's series of the weight at the start of every control step, times the difference.
    phases, step = np.arange(steps + 1.0) / (steps + 1.0), 1.0 / (steps + 1.0)
    for power in range(6):
        weight = np.polyval(np.polyder(_SMOOTHSTEP, power), phases) * step**power / math.factorial(power)
        pieces[5 - power : 9 - power] += weight[:, None] * differences
    return pieces


def _cubics(positions: Array, rates: Array) -> Array:
    """Coefficients of the cubic Hermite spline, one step apart, highest power first, shape (4, k - 1, m)."""
    from scipy.interpolate import CubicHermiteSpline

    return np.asarray(CubicHermiteSpline(np.arange(float(len(positions))), positions, rates).c)
