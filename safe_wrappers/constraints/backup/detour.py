"""On which side an obstacle is being passed."""

from typing import NamedTuple


class Detour(NamedTuple):
    """What a clearance with detours remembers of an episode.

    Attributes:
        side: 1.0 is the left one, -1.0 the right one.
        steps: Control steps for which the side is kept after it was last needed, so that it cannot dither.
    """

    side: float = 0.0
    steps: int = 0
