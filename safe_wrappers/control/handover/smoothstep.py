"""Bumpless transfer: the smoothstep, and the shortest blend of two commands that a rate limit allows.

The limit bounds the time derivative of a command u, in units of u per second, not the plant's response.
Source: appendix "Bumpless transfer and smoothstep blending".
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array

SMOOTHSTEP_PEAK_RATE = 1.875
"""Largest derivative of the smoothstep, alpha'(1/2)."""

ROUND_UP = 1.0 + 1e-12
"""Blend times are lengthened by this factor, so that rounding never makes them too short."""


def smoothstep(s: ArrayLike) -> Array:
    """alpha(s) = 6 s^5 - 15 s^4 + 10 s^3 for s in [0, 1], 0 before it and 1 after it, of any shape."""
    s = np.clip(np.asarray(s, dtype=np.float64), 0.0, 1.0)
    near = np.minimum(s, 1.0 - s)  # alpha(1 - s) = 1 - alpha(s): the half without cancellation
    half = near**3 * (near * (6.0 * near - 15.0) + 10.0)
    return np.asarray(np.where(s <= 0.5, half, 1.0 - half))


def shortest_latched_blend(step: Array | float, rate_limit: Array | float) -> Array:
    """Shortest blend time in s between two constant commands: 1.875 |step| / rate_limit, rounded up."""
    return np.asarray(SMOOTHSTEP_PEAK_RATE * np.abs(step) / rate_limit * ROUND_UP)
