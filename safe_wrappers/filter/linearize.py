"""Half-spaces from predicted slacks, linearised about a control that the prediction has refused."""

from collections.abc import Callable

import numpy as np

from safe_wrappers.errors import Array
from safe_wrappers.filter.constraint import HalfSpaces

Slacks = Callable[[Array], Array]
"""Control (m,) to what is left of the requirement along the held step, (k,); wanted >= 0."""

_STEP = 1e-4  # width of the differences, as a share of the control's range
_INWARD = 0.01  # aim this share of the violation beyond the boundary, to end inside it
_AGAIN = 0.1  # likewise of the little that is left when a tangent is corrected
_SECANTS = 2  # tangents whose slopes secants correct, after one by differences
_DIFFERENCES = 4  # tangents by differences, in one control step


def differences(slacks: Slacks, control: Array, low: Array, high: Array) -> Array:
    """How slacks change with a control, shape (k, m); the differences stay inside the bounds, shapes (m,)."""
    base = slacks(control)
    width = np.where(np.isfinite(high - low), _STEP * (high - low), _STEP)
    width = np.where(control + width > high, -width, width)
    jacobian = np.zeros((base.size, control.size))
    for j in np.flatnonzero(width):
        moved = control.copy()
        moved[j] += width[j]
        jacobian[:, j] = (slacks(moved) - base) / width[j]
    return jacobian


class Tangents:
    """Tangents of the slacks of one control step, where differences are dear.

    One is made by differences. The next ones have its slopes, corrected so that they explain what the slacks have
    changed by since (Broyden's secant update); they are provisional. Then differences are made again.

    Args:
        slacks: Of a control.
        slopes: How the first of them change with it, shape (k or less, m), by differences.
        kept: Slopes of a control step before, to begin with.

    Attributes:
        slopes: The latest; None before the first tangents.
        made: How often they were made by differences.
    """

    def __init__(self, slacks: Slacks, slopes: Slacks, kept: Array | None = None) -> None:
        self._of, self._by_differences = slacks, slopes
        self._control: Array | None = None
        self.slopes = kept
        self._secants = self.made = 0

    def about(self, control: Array) -> HalfSpaces:
        """The tangents about a refused control; no rows: there were enough."""
        slacks, known = self._of(control), self._control
        slopes = self.slopes
        if slopes is not None and known is not None:
            corrects = self._secants < _SECANTS
            slopes = self._corrected(slopes, control - known, slacks) if corrects else None
        guessed = slopes is not None
        if slopes is None:
            stuck = known is not None and not self._secants and np.array_equal(control, known)
            if stuck or self.made == _DIFFERENCES:
                return HalfSpaces.none(control.size)
            slopes = self._by_differences(control)
            self.made, self._secants = self.made + 1, 0
        else:
            self._secants += known is not None
        self.slopes, self._control, self._slacks = slopes, control, slacks[: len(slopes)]
        wanted = (_AGAIN if guessed else _INWARD) * np.maximum(-self._slacks, 0.0)
        return HalfSpaces(-slopes, self._slacks - slopes @ control - wanted, provisional=guessed)

    def _corrected(self, slopes: Array, step: Array, slacks: Array) -> Array | None:
        """The slopes after a secant update; None: it cannot be made, or they are not those of what is violated."""
        k = len(slopes)
        unexplained = slacks[:k] - self._slacks - slopes @ step
        square = float(step @ step)
        if not (square > 0.0 and np.isfinite(unexplained).all() and slacks[:k].min() < 0.0):
            return None
        return np.asarray(slopes + np.outer(unexplained, step / square))
