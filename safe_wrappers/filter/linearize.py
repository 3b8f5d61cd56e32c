"""Half-spaces from predicted slacks, linearised about a control that the prediction has refused."""

from collections.abc import Callable

import numpy as np

from safe_wrappers.filter.constraint import Array, HalfSpaces

_STEP = 1e-4  # width of the differences, as a share of the control's range
_INWARD = 0.01  # aim this share of the violation beyond the boundary, to end inside it


def linearize(slacks: Callable[[Array], Array], control: Array, low: Array, high: Array) -> HalfSpaces:
    """Linearise predicted slacks about a control.

    Args:
        slacks: Control (m,) to what is left of the requirement along the held step, (k,); wanted >= 0.
        control: The refused control, shape (m,).
        low: Bounds that the differences stay inside, shape (m,).
        high: Likewise.

    Returns:
        k rows `-J u <= slacks(control) - J control`, aimed a little inward where a slack is negative.
    """
    base = slacks(control)
    width = np.where(np.isfinite(high - low), _STEP * (high - low), _STEP)
    width = np.where(control + width > high, -width, width)
    jacobian = np.empty((base.size, control.size))
    for j in range(control.size):
        moved = control.copy()
        moved[j] += width[j]
        jacobian[:, j] = (slacks(moved) - base) / width[j] if width[j] else 0.0
    return tangent_rows(base, control, jacobian)


def tangent_rows(base: Array, control: Array, jacobian: Array) -> HalfSpaces:
    """Rows of slacks that are `base` at a control and change by a Jacobian, aimed a little inward where violated."""
    wanted = _INWARD * np.maximum(-base, 0.0)
    return HalfSpaces(-jacobian, base - jacobian @ control - wanted)
