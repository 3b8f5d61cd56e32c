"""A projection's answer, and the sizes that say what is small: shares of the problem's own size, N or MN alike."""

from enum import StrEnum
from typing import Final, NamedTuple

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled

FEASIBILITY_TOLERANCE: Final = 1e-9
"""Largest residual that the nominal may have, as a share of `residual_scale`; answers may have ten times as much."""
EXACT_SHARE: Final = 1e-3
"""Share of what the nominal is allowed that round-off leaves. More may be far from every admissible control."""
_NARROWEST: Final = (
    1e-6  # a box narrower than this share of its distance from zero counts as this wide: rounding
)
ORDINARY_BOX: Final = 16.0
"""The sizes of the numbers matter where half a box is wider."""
_NO_BOUND: Final = (
    1e15  # a box that reaches farther (control units) bounds nothing and says nothing of controls
)
UNBOUNDED: Final = 1e30
"""What daqp takes as "no bound"."""


class Status(StrEnum):
    """How a projection ended."""

    INACTIVE = "inactive"
    """The nominal control satisfies everything; `control` is that control, bit for bit."""
    PROJECTED = "projected"
    """`control` is the closest admissible control, residual checked."""
    INFEASIBLE = "infeasible"
    """No control in the box satisfies every row; `control` violates them least."""
    FAILED = "failed"
    """No method gave an answer that passed the check; `control` is only inside the box."""


class Projection(NamedTuple):
    """An answer that has been checked.

    Attributes:
        control: Shape (m,), always finite and inside the box.
        status: See `Status`; compares equal to its string.
        violation: Largest `normals @ control - offsets` over all rows, at least 0, in row units.
        multipliers: One per row, shape (k,), at least 0; zeros unless `projected`. The box's own are not among them.
        iterations: Changes of the active set, or what a named solver counts.
    """

    control: Array
    status: Status
    violation: float
    multipliers: Array
    iterations: int


@compiled
def residual_scale(box: float, length: float, values: float, widest: float) -> float:
    """What a row's residual is compared with, row units.

    Args:
        box: How far the row's value changes over half of the box.
        length: Of the normal: what it changes by over one control unit.
        values: Size of the two numbers that the row compares.
        widest: Half of the box's largest width, control units.
    """
    if widest <= ORDINARY_BOX:
        return box
    return values if box >= _NO_BOUND * length else min(box, max(values, length))


@compiled
def half_width(low: float, high: float) -> float:
    """Half of what a box spans in one component, control units."""
    return min(max(0.5 * high - 0.5 * low, _NARROWEST * max(high, -low)), UNBOUNDED)
