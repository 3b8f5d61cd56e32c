"""Unilateral contact: residuals of `gap >= 0`, `force >= 0`, `gap * force = 0`.

Source: appendix "Rigid Body Contact Mechanics". Compliant contacts, MuJoCo's among them, violate this by design:
their force comes from a penetration or a margin. Small residuals do not validate a simulation.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import finite_arrays

Array = NDArray[np.float64]


class ComplementarityResiduals(NamedTuple):
    """Violations of the three conditions, each shape (...), 0 where they hold: m, N and N m."""

    penetration: Array
    tension: Array
    product: Array


def complementarity_residuals(gap: ArrayLike, force: ArrayLike) -> ComplementarityResiduals:
    """The residuals of contacts, one by one.

    Args:
        gap: Signed distance, m, shape (...): negative where the bodies penetrate.
        force: Normal force, N, shape (...): positive pushes the bodies apart.
    """
    g, f = finite_arrays(gap=gap, force=force)
    return ComplementarityResiduals(np.maximum(-g, 0.0), np.maximum(-f, 0.0), np.abs(g * f))
