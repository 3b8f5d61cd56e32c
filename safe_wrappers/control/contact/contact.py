"""Contacts: residuals of `gap >= 0`, `force >= 0`, `gap * force = 0` (unilateral contact), and springs in series.

Source: appendix "Rigid Body Contact Mechanics". Compliant contacts, MuJoCo's among them, violate this by design:
their force comes from a penetration or a margin. Small residuals do not validate a simulation.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays, float_array
from safe_wrappers.errors import ConfigurationError


class ComplementarityResiduals(NamedTuple):
    """Violations of the three conditions, each shape (...), 0 where they hold: m, N and N m."""

    penetration: Array
    tension: Array
    product: Array


def complementarity_residuals(gap: ArrayLike, force: ArrayLike) -> ComplementarityResiduals:
    """The residuals of contacts, one by one.

    The gap is a signed distance, m, shape (...), negative where the bodies penetrate; the force is along the normal,
    N, shape (...), positive where it pushes the bodies apart.
    """
    g, f = finite_arrays(gap=gap, force=force)
    return ComplementarityResiduals(np.maximum(-g, 0.0), np.maximum(-f, 0.0), np.abs(g * f))


def series_stiffness(*stiffness: ArrayLike) -> Array:
    """Stiffness of springs in series, `1 / k = 1/k1 + 1/k2 + ...`, shape (...), N/m.

    Args:
        *stiffness: One or more, N/m, > 0, shape (...); inf is rigid.
    """
    if not stiffness:
        raise ConfigurationError("series_stiffness needs at least one stiffness")
    return in_series(*(positive("stiffness", k) for k in stiffness))


def positive(name: str, value: ArrayLike) -> Array:
    """Positive numbers as float64, inf included."""
    array = float_array(name, value)
    if not (array > 0.0).all():
        raise ConfigurationError(f"{name} must be positive, got {array}")
    return array


def in_series(*parts: Array) -> Array:
    """`1 / (1/p1 + 1/p2 + ...)`, shape (...); inf for a sum of zero."""
    total: Array = np.zeros(())
    for part in parts:
        total = total + 1.0 / part
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / total)
