"""A box mapped onto the admitted controls inside it, along rays from a control that is admitted.

A control at a share t of the way from the anchor to the edge of the box goes to the share t of the way from the
anchor to the edge of what is admitted. So controls on a ray keep their order, and all of them are admitted.

Source: the ray mask of Stolz et al., Excluding the Irrelevant: Focusing Reinforcement Learning through Continuous
Action Masking, NeurIPS 2024, with the edge of the admitted controls found by asking.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from safe_wrappers.checks import Array

_MARCH: Final = (0.25, 0.5, 0.75, 1.0)
"""Shares of the ray that are asked outward, until one is refused: what is admitted need not end only once."""
_HALVINGS: Final = 8
"""Of the stretch in which the edge lies: it is found to a thousandth of the ray."""
_ROUGHLY: Final = 5
"""Halvings for an end of which only the middle is wanted."""
_CLOSER: Final = 4
"""How often a mapped control that is refused itself is taken for the edge."""

_STILL: Final = 1e-9
"""Components that move by a smaller share than the largest do not end the ray; `at` clips them."""


def rounded(control: Array, low: Array, high: Array, dtype: Any) -> Array:
    """A control as it can be executed: inside the box, a number of the actions' dtype."""
    inside = np.minimum(np.maximum(control, low), high)
    return inside if dtype == np.float64 else inside.astype(dtype).astype(np.float64)


class Ray:
    """The controls from an anchor through another control to the edge of the box, as they can be executed.

    Args:
        anchor: Inside the box, shape (m,).
        through: Likewise, another one.
        low: Box, shape (m,), finite.
        high: Likewise.
        dtype: Of the actions: controls are rounded to it before they are asked about.

    Attributes:
        place: Where `through` is on the ray, in (0, 1].
    """

    def __init__(self, anchor: Array, through: Array, low: Array, high: Array, dtype: Any) -> None:
        self._anchor, self._low, self._high, self._dtype = anchor, low, high, dtype
        away = through - anchor
        length = float(np.abs(away).max())
        direction = away / length
        moving = np.abs(direction) > _STILL
        bound = np.where(direction > 0.0, high, low)[moving]
        reach = float(((bound - anchor[moving]) / direction[moving]).min())
        # In exact arithmetic the ray reaches as far as the control that it goes through.
        self._whole = max(reach, length) * direction
        self.place = min(length / reach, 1.0) if reach > length else 1.0

    def at(self, share: float) -> Array:
        """The control at a share of the ray, shape (m,)."""
        return rounded(self._anchor + share * self._whole, self._low, self._high, self._dtype)


def mapped_on_ray(admits: Callable[[Array], bool], ray: Ray, through: Array) -> tuple[Array, float]:
    """A control moved towards the anchor as far as the ray's admitted part is shorter than the ray.

    Args:
        admits: Whether a control is admitted; the anchor is.
        ray: From the anchor through the control.
        through: The control, shape (m,), or one beyond it with the same effect.

    Returns:
        The control that is admitted, shape (m,), and by what its distance from the anchor was multiplied. `through`
        itself and 1 where the whole ray is admitted. The anchor and 0 where the admitted part is shorter than a
        thousandth of the ray.
    """
    near = 0.0
    for share in _MARCH:
        if not admits(ray.at(share)):
            return _inside(admits, ray, near, share)
        near = share
    if admits(through):
        return through, 1.0
    # Between two shares that are admitted: what lies beyond it is another stretch.
    near = max((share for share in _MARCH if share < ray.place), default=0.0)
    return _inside(admits, ray, near, ray.place)


def _inside(admits: Callable[[Array], bool], ray: Ray, near: float, far: float) -> tuple[Array, float]:
    """Between a share that is admitted and one that is not."""
    for _ in range(_CLOSER):
        for _ in range(_HALVINGS):
            middle = 0.5 * (near + far)
            if admits(ray.at(middle)):
                near = middle
            else:
                far = middle
        control = ray.at(near * ray.place)
        if admits(control):
            return control, near
        near, far = 0.0, near * ray.place
    return ray.at(0.0), 0.0


def centre(admits: Callable[[Array], bool], start: Array, low: Array, high: Array, dtype: Any) -> Array:
    """From an admitted control to the middle of what is admitted: component by component halfway between its ends.

    Args:
        admits: Whether a control is admitted; `start` is.
        start: Shape (m,).
        low: Box, shape (m,), finite.
        high: Likewise.
        dtype: Of the actions.

    Returns:
        A control that is admitted, shape (m,).
    """
    found = start
    for j in range(start.size):
        ends = [_end(admits, found, j, bound[j], low, high, dtype) for bound in (low, high)]
        middle = found.copy()
        middle[j] = 0.5 * (ends[0] + ends[1])
        middle = rounded(middle, low, high, dtype)
        if admits(middle):
            found = middle
    return found


def _end(
    admits: Callable[[Array], bool], start: Array, j: int, bound: float, low: Array, high: Array, dtype: Any
) -> float:
    """How far component j may go towards its bound."""
    near, far = start[j], bound
    control = start.copy()
    control[j] = bound
    if admits(rounded(control, low, high, dtype)):
        return bound
    for _ in range(_ROUGHLY):
        control[j] = 0.5 * (near + far)
        if admits(rounded(control, low, high, dtype)):
            near = control[j]
        else:
            far = control[j]
    return float(near)
