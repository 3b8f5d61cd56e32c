"""Exact projection on one half-space and the box: the breakpoints of a piecewise linear function, in order."""

import math
import operator

import numpy as np

from safe_wrappers.filter.problem import (
    FEASIBILITY_TOLERANCE,
    ORDINARY_BOX,
    Array,
    Projection,
    Status,
    box_size,
    residual_scale,
)


def project_single_row(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> Projection:
    """Exact projection on one half-space and the box, in scalars: at this size they beat arrays.

    The solution is `clip(u - lam * a, lo, hi)` for the smallest lam >= 0 at which `a @ clip(...)`, non-increasing and
    piecewise linear in lam, has come down to the limit. Where it never does, the corner with the smallest `a @ u`
    violates least.
    """
    nominal, slope, low, high = u.tolist(), a[0].tolist(), lo.tolist(), hi.tolist()
    limit = float(b[0])
    square = dot = value = 0.0
    inside = True
    for x, s, bottom, top in zip(nominal, slope, low, high, strict=True):
        square += s * s
        dot += s * x
        if x < bottom or x > top:
            inside = False
            x = bottom if x < bottom else top
        if s:
            value += s * x
    if square - square != 0.0 or limit - limit != 0.0:
        # An offset of +inf asks for nothing; what else is not finite cannot be checked.
        return _box_only(u, lo, hi, inside, failed=not (limit == math.inf and square < math.inf))
    if inside and dot <= limit:
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(1), 0)
    length = math.sqrt(square)
    box = box_size(lo.tobytes(), hi.tobytes())
    reach = length * box.widest if box.even else math.hypot(*map(operator.mul, slope, box.half))
    if box.widest > ORDINARY_BOX:
        reach = residual_scale(reach, length, length * max(map(abs, nominal)) + abs(limit))
    slack = FEASIBILITY_TOLERANCE * reach
    if inside and dot - limit <= slack:
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(1), 0)
    lam = _multiplier(nominal, slope, low, high, value, limit) if value > limit and square > 0.0 else 0.0
    control, excess, falling = _moved(nominal, slope, low, high, limit, lam)
    if excess > slack and falling > 0.0:  # entries of very different size: round-off of the walk
        lam += excess / falling
        control, excess, _ = _moved(nominal, slope, low, high, limit, lam)
    if excess - excess != 0.0:  # a slope so small that the multiplier overflowed
        return Projection(np.clip(u, lo, hi), Status.FAILED, max(0.0, value - limit), np.zeros(1), 0)
    if excess <= 10.0 * slack:
        return Projection(np.array(control), Status.PROJECTED, max(0.0, excess), np.array([lam]), 0)
    return Projection(np.array(control), Status.INFEASIBLE, excess, np.zeros(1), 0)


def _box_only(u: Array, lo: Array, hi: Array, inside: bool, failed: bool) -> Projection:
    """The answer without the row."""
    status = Status.FAILED if failed else Status.INACTIVE if inside else Status.PROJECTED
    control = u if inside else np.clip(u, lo, hi)
    return Projection(control, status, math.inf if failed else 0.0, np.zeros(1), 0)


def _moved(
    nominal: list[float], slope: list[float], low: list[float], high: list[float], limit: float, lam: float
) -> tuple[list[float], float, float]:
    """The control at a multiplier, by how much it misses the limit, and how fast that falls with the multiplier."""
    control, value, falling = [], 0.0, 0.0
    for x, s, bottom, top in zip(nominal, slope, low, high, strict=True):
        moved = min(max(x - lam * s, bottom), top) if s else min(max(x, bottom), top)
        control.append(moved)
        if s:
            value += s * moved
            if bottom < moved < top:
                falling += s * s
    return control, value - limit, falling


def _multiplier(
    nominal: list[float], slope: list[float], low: list[float], high: list[float], value: float, limit: float
) -> float:
    """The smallest lam at which the row is met, or the one at which every component has hit its bound."""
    falling = 0.0  # -d value / d lam on the current stretch
    events: list[tuple[float, float]] = []
    for x, s, bottom, top in zip(nominal, slope, low, high, strict=True):
        if not s:
            continue
        enter, leave = ((x - top) / s, (x - bottom) / s) if s > 0.0 else ((x - bottom) / s, (x - top) / s)
        if leave <= 0.0:
            continue
        if enter <= 0.0:
            falling += s * s
        else:
            events.append((enter, s * s))
        if leave < math.inf:
            events.append((leave, -s * s))
    lam = 0.0
    events.sort()
    for at, change in events:
        if value - falling * (at - lam) <= limit:
            break
        value -= falling * (at - lam)
        lam = at
        falling += change
    if value > limit and falling > 1e-300:
        lam += (value - limit) / falling
    return lam
