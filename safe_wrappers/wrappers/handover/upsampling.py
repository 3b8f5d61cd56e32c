"""Upsampling: a chunk at the policy's rate as commands at the robot's."""

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.handover.splines import hermite_series

Array = NDArray[np.float64]


class Upsampling:
    """Entries that lie some control steps apart, and between them a cubic Hermite spline through the entries.

    So a chunk at 30 Hz drives a loop at 1 kHz without a staircase. The commands' rate is continuous, with the rates
    at the entries taken from their neighbours; nothing is extrapolated: a chunk ends with its last entry, at which
    one command is left. Between entries the spline may overshoot their range; what leaves the action box is clipped
    by who sends it.

    Args:
        entries: H.
        steps: Control steps from one entry to the next; 1 changes nothing.
    """

    def __init__(self, entries: int, steps: int) -> None:
        self._steps = steps
        if steps > 1:
            times = np.arange(entries) * float(steps)
            unit = np.eye(entries)
            rates = np.asarray(np.gradient(unit, axis=1)) / steps
            # The spline is linear in the entries: one matrix for all chunks.
            self._weights = hermite_series(times, unit, rates, np.arange((entries - 1) * steps + 1)).T

    def commands(self, chunk: Array) -> Array:
        """The commands of a chunk, shape ((H - 1) steps + 1, m); at the entries these bit for bit.

        Args:
            chunk: Shape (H, m).
        """
        if self._steps == 1:
            return chunk
        commands = self._weights @ chunk
        commands[:: self._steps] = chunk
        return commands
