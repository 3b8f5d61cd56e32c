"""Bounds on joint accelerations that keep positions within their ranges until the end of a control step.

Source: appendix "Hierarchical whole-body control quadratic program", its caveat: a bound at the present position does
not cover the motion between samples. Choose the horizon no shorter than stopping takes.
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays, positive
from safe_wrappers.errors import ConfigurationError


def largest_acceleration(distance: ArrayLike, speed: ArrayLike, horizon_s: float) -> Array:
    """The largest constant acceleration that stays within a limit until a horizon > 0, shape (...).

    The distance to the limit is in m or rad, the speed towards it in m/s or rad/s. From beyond the limit (a negative
    distance): the largest that returns to it by the end of the horizon.
    """
    d, v = finite_arrays(distance=distance, speed=speed)
    positive("horizon_s", horizon_s, "s")
    at_end = 2.0 * (d - horizon_s * v) / horizon_s**2
    # Where the top of the parabola is before the end, the top may just reach the limit.
    top_is_inside = (d > 0.0) & (2.0 * d < horizon_s * v)
    with np.errstate(over="ignore"):  # very close to the limit: the largest finite number
        at_top = np.maximum(-(v * v) / (2.0 * np.where(d > 0.0, d, 1.0)), -np.finfo(np.float64).max)
    return np.asarray(np.where(top_is_inside, at_top, at_end))


def predicted_position_rows(
    dofs: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    horizon_s: float,
    nv: int,
) -> tuple[Array, Array]:
    """Rows `G qacc <= g`, shapes (m, nv) and (m,), that keep joints in range until the horizon, upper limits first.

    The acceleration is constant; there is one row for each finite limit.

    Args:
        dofs: Indices of the joints' degrees of freedom (slides and hinges), shape (n,).
        positions: Shape (n,), m or rad.
        velocities: Shape (n,).
        lower: Smallest positions, shape (n,); -inf is no limit.
        upper: Largest positions, shape (n,); inf is no limit.
        horizon_s: s; a control step, or the time that stopping takes if that is longer.
        nv: Degrees of freedom of the whole model.
    """
    q, v = finite_arrays(positions=positions, velocities=velocities)
    which = np.asarray(dofs)
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if q.ndim != 1 or not (which.shape == low.shape == high.shape == q.shape):
        shapes = f"{which.shape}, {q.shape}, {low.shape} and {high.shape}"
        raise ConfigurationError(f"expected dofs, positions, lower and upper of one shape (n,), got {shapes}")
    if not np.issubdtype(which.dtype, np.integer) or not ((which >= 0) & (which < nv)).all():
        raise ConfigurationError(f"dofs are indices from 0 to {nv - 1}, got {which}")
    if not (low <= high).all():
        raise ConfigurationError(f"lower must not exceed upper, got {low} and {high}")
    above, below = np.isfinite(high), np.isfinite(low)
    units = np.eye(nv)[which]
    rows = np.concatenate([units[above], 0.0 - units[below]])  # 0 - x: no negative zeros
    upwards = largest_acceleration(high[above] - q[above], v[above], horizon_s)
    downwards = largest_acceleration(q[below] - low[below], -v[below], horizon_s)
    return rows, np.concatenate([upwards, downwards])
