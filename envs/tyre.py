"""One tyre's force on the ground, from how it slips along and across its heading at once."""

import math
from typing import Final

from .ground import MagicFormula

SLOWEST: Final = 0.5
"""Speed below which slip counts against this speed, m/s: at rest there is no ratio."""


def tyre_force(
    rim: float, forward: float, sideways: float, load: float, curve: MagicFormula
) -> tuple[float, float, float]:
    """Force of the ground on a wheel: against the sliding of the contact point, as much as the curve gives.

    Both slips count against one speed, `max(|forward|, |rim|, SLOWEST)`, and share one curve (a friction circle):
    who spins or locks a wheel loses its grip across, too. As the force opposes the sliding, a tyre only ever takes
    energy away.

    Plain numbers, as this runs for every wheel at every physics substep.

    Args:
        rim: Circumferential speed r w, m/s.
        forward: Speed of the wheel over ground along its heading, m/s.
        sideways: The same to its left, m/s.
        load: F_z, N; a wheel without load gets no force.
        curve: The ground's.

    Returns:
        Force along the heading and to the left, N, and the longitudinal slip.
    """
    over = 1.0 / max(abs(forward), abs(rim), SLOWEST)
    along, across = (rim - forward) * over, -sideways * over
    slip = math.hypot(along, across)
    if load <= 0.0 or slip == 0.0:
        return 0.0, 0.0, along
    share = curve.at(slip) * load / slip
    return share * along, share * across, along
