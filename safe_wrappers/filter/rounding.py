"""Casting a control to the action space's dtype without rounding it across a half-space."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cast_inside(control: Array, dtype: Any, normals: Array, offsets: Array, low: Array, high: Array) -> Any:
    """The control in `dtype`, one unit in the last place towards feasibility where rounding broke a row.

    Args:
        control: Shape (m,), inside the box and the rows.
        dtype: Of the action space.
        normals: Shape (k, m); k may be 0.
        offsets: Shape (k,).
        low: Box, shape (m,), exact in `dtype`.
        high: Box, likewise.

    Returns:
        Shape (m,), `dtype`, inside the box.
    """
    sent = np.clip(control, low, high).astype(dtype)
    if not offsets.size or dtype == np.float64:
        return sent
    excess = normals @ sent.astype(np.float64) - np.maximum(offsets, normals @ control)
    worst = int(excess.argmax())
    if excess[worst] <= 0.0:
        return sent
    towards = np.where(normals[worst] > 0.0, -np.inf, np.where(normals[worst] < 0.0, np.inf, sent))
    return np.clip(np.nextafter(sent, towards.astype(dtype)), low.astype(dtype), high.astype(dtype))
