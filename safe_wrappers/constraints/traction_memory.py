"""What `Traction` carries from one control step to the next."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.vehicle.friction_estimate import FrictionEstimate

Array = NDArray[np.float64]


class TractionMemory(NamedTuple):
    """What Traction remembers of an episode; arrays of shape (wheels,), before the last control.

    Attributes:
        estimate: Of the ground's friction.
        rate: Turning rates, rad/s; None: nothing was measured.
        time: s.
        ground: Speeds of the ground below, m/s.
        slip: Slip ratios along the heading.
        across: And across it.
        load: Forces on the ground, N.
        most_load: The largest so far, N.
        faster: Recent error of the predicted ground speed, upwards, m/s.
        slower: Downwards, m/s.
        ahead: By how much the ground speed is predicted to change, m/s.
        traction: Force of the ground in the last control step, N.
        present: Of the ground at its end, N.
    """

    estimate: FrictionEstimate
    rate: Array | None
    time: float
    ground: Array
    slip: Array
    across: Array
    load: Array
    most_load: Array
    faster: Array
    slower: Array
    ahead: Array
    traction: Array
    present: Array
