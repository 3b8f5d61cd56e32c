"""Barriers in continuous time: the stopping inset, the boundary test of Nagumo, power-law decay.

Source: appendix "Relative degree and kinetic stopping insets" and "Safety and Control Barrier Functions".
`safe_wrappers.control.backup.stopping` has the forms that hold between samples.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array


def kinetic_inset(clearance: ArrayLike, speed: ArrayLike, brake: float) -> Array:
    """`h = D - v^2 / (2 a_brake)`; receding (v <= 0) needs no stopping distance.

    Args:
        clearance: Distance to the obstacle D in m (or rad), shape (...).
        speed: Approach speed v in m/s, positive towards the obstacle, shape (...).
        brake: a_brake in m/s^2, positive.
    """
    approach = np.maximum(np.asarray(speed, dtype=np.float64), 0.0)
    return np.asarray(np.asarray(clearance, dtype=np.float64) - approach**2 / (2.0 * brake))


def kinetic_row(clearance: ArrayLike, speed: ArrayLike, brake: float, gamma: float) -> Array:
    """The continuous row: the largest admissible approach acceleration, `(a_brake / v)(gamma h - v)`.

    For v > 0. At standstill the row is singular: +inf is returned where the inset is positive, else 0 (the start
    rule of the continuous form: do not start to move).
    """
    v = np.asarray(speed, dtype=np.float64)
    h = kinetic_inset(clearance, speed, brake)
    moving = v > 0.0
    safe_v = np.where(moving, v, 1.0)
    return np.asarray(np.where(moving, brake / safe_v * (gamma * h - safe_v), np.where(h > 0.0, np.inf, 0.0)))


def power_decay(h: ArrayLike, alpha: float, power: float) -> Array:
    """The extended class-K function `alpha * sign(h) |h|^power`: odd, so an unsafe state is driven back.

    Below 1, `power` lets the state come close quickly and brakes late; above 1 it brakes early.
    """
    value = np.asarray(h, dtype=np.float64)
    return np.asarray(alpha * np.sign(value) * np.abs(value) ** power)


def best_rate(lf_h: ArrayLike, lg_h: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """The largest `h'` that any control in the box reaches, shape (...)."""
    effect = np.asarray(lg_h, dtype=np.float64)
    corner = np.where(effect > 0, np.asarray(upper), np.where(effect < 0, np.asarray(lower), 0.0))
    return np.asarray(np.asarray(lf_h) + np.einsum("...m,...m->...", effect, corner))


def nagumo_holds(
    h: ArrayLike,
    lf_h: ArrayLike,
    lg_h: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    boundary: float = 1e-9,
) -> NDArray[np.bool_]:
    """Nagumo's test at the boundary: on `|h| <= boundary` some control in the box gives `h' >= 0`.

    Away from the boundary the tangent cone is the whole space and the test holds; outside the set
    (`h < -boundary`) invariance is already lost and it does not.

    Returns:
        Boolean array of shape (...).
    """
    value = np.asarray(h, dtype=np.float64)
    on_boundary = np.abs(value) <= boundary
    viable = best_rate(lf_h, lg_h, lower, upper) >= 0.0
    return np.asarray((value > boundary) | (on_boundary & viable))
