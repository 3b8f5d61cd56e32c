"""A projection's answer, and the sizes that say what is small: shares of the problem's own size, N or MN alike."""

import functools
import math
from enum import StrEnum
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEASIBILITY_TOLERANCE = 1e-9
"""Largest residual that the nominal may have, as a share of `residual_scales`; answers may have ten times as much."""
EXACT_SHARE = 1e-3
"""Share of what the nominal is allowed that round-off leaves. More may be far from every admissible control."""
_NARROWEST = 1e-6  # a box narrower than this share of its distance from zero counts as this wide: rounding
ORDINARY_BOX = 16.0
"""Boxes within this factor of one are not rescaled: a solver's tolerances fit them as they are."""
NO_BOUND = 1e15
"""A box that reaches farther (control units) bounds nothing and says nothing of the size of controls."""
UNBOUNDED = 1e30
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
    """No backend gave an answer that passed the check; `control` is only inside the box."""


class Projection(NamedTuple):
    """An answer that has been checked.

    Attributes:
        control: Shape (m,), always finite and inside the box.
        status: See `Status`; compares equal to its string.
        violation: Largest `normals @ control - offsets` over all rows, at least 0, in row units.
        multipliers: One per row, shape (k,), at least 0; zeros unless `projected`. The box's own are not among them.
        iterations: Of the backend; 0 where no solver was called.
    """

    control: Array
    status: Status
    violation: float
    multipliers: Array
    iterations: int


class BoxSize(NamedTuple):
    """How wide a box is."""

    half: tuple[float, ...]  # half of its width, per component
    widest: float  # the largest half
    even: bool  # all are the same
    ordinary: bool  # controls are of order one


@functools.lru_cache(maxsize=256)
def box_size(lower: bytes, upper: bytes) -> BoxSize:
    """The widths of a box, from its bounds' bytes: most boxes are asked about at every control step."""
    half = tuple(
        min(max(0.5 * top - 0.5 * bottom, _NARROWEST * max(top, -bottom)), UNBOUNDED)
        for bottom, top in zip(np.frombuffer(lower).tolist(), np.frombuffer(upper).tolist(), strict=True)
    )
    widest = max(half, default=0.0)
    even, ordinary = widest == min(half, default=0.0), 1.0 / ORDINARY_BOX <= widest <= ORDINARY_BOX
    return BoxSize(half, widest, even, ordinary)


def residual_scale(box: float, length: float, values: float) -> float:
    """What a row's residual is compared with, row units.

    Args:
        box: How far the row's value changes over half of the box.
        length: Of the normal: what it changes by over one control unit.
        values: Size of the two numbers that the row compares.
    """
    return values if box >= NO_BOUND * length else min(box, max(values, length))


def residual_scales(u: Array, a: Array, b: Array, length: Array, box: BoxSize) -> Array:
    """`residual_scale` of every row, shape (k,): of the box, or of the row's own numbers where the box is wide."""
    if box.even:
        reach = length * box.widest
    else:
        scaled = a * np.array(box.half)
        reach = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))
    if box.widest <= ORDINARY_BOX:
        return reach
    values = length * max(map(abs, u.tolist())) + np.abs(b)
    return np.array([*map(residual_scale, reach.tolist(), length.tolist(), values.tolist())])


def batch_residual_scales(u: Array, a: Array, b: Array, length: Array, lo: Array, hi: Array) -> Array:
    """`residual_scales` of B problems, shape (B, k); the box has shape (B, m)."""
    half = np.minimum(np.maximum(0.5 * hi - 0.5 * lo, _NARROWEST * np.maximum(hi, -lo)), UNBOUNDED)
    widest = half.max(axis=1, keepdims=True, initial=0.0)
    reach = cast(Array, np.sqrt(np.einsum("bkm,bm->bk", a * a, half * half)))
    if bool((widest <= ORDINARY_BOX).all()):
        return reach
    values = length * np.abs(u).max(axis=1, keepdims=True) + np.abs(b)
    open_box = np.where(reach >= NO_BOUND * length, values, np.minimum(reach, np.maximum(values, length)))
    return cast(Array, np.where(widest <= ORDINARY_BOX, reach, open_box))


def control_unit(box: BoxSize, u: Array, excess: Array, length: Array) -> float:
    """A power of two of the size of the controls in question."""
    size = box.widest
    if size > ORDINARY_BOX:
        away = float((excess / np.where(length > 0.0, length, np.inf)).max())
        size = residual_scale(size, 1.0, max(max(map(abs, u.tolist())), away))
    return math.ldexp(0.5, math.frexp(size)[1]) if size > 0.0 else 1.0
