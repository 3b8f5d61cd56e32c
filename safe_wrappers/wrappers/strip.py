"""The strip over a frame's lower edge: what was done to the last actions."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys

Pixels = NDArray[np.uint8]

STEPS: Final = 150
"""How many of the last steps the strip shows."""
STATES: Final[dict[str, tuple[tuple[int, int, int], tuple[str, ...]]]] = {
    "violation": ((230, 45, 60), (keys.COST_SUBSTEP, keys.COST)),
    "fallback": ((250, 110, 30), (keys.CBF_FALLBACK,)),
    "braked": ((80, 160, 250), (keys.LEASE_BRAKING, keys.TELEOP_REVOKED)),
    "changed": ((250, 180, 20), (keys.CBF_INTERVENED,)),
    "as proposed": ((150, 158, 168), ()),
}
"""What is said of a step, the worst first: its colour, and the info keys of which one above 0 says so."""
_EMPTY: Final = (40, 42, 46)


def state_of(info: dict[str, Any]) -> str:
    """Which of `STATES` a step was in."""
    found = (state for state, (_, signs) in STATES.items() if any(info.get(sign, 0) > 0 for sign in signs))
    return next(found, "as proposed")


def with_strip(frame: Pixels, states: Sequence[str]) -> Pixels:
    """A copy of a frame, shape (height, width, 3), with a column per step over its lower edge, the last at the right.

    `states` are those of the steps, the newest last, at most `STEPS`.
    """
    picture = np.array(frame[..., :3], dtype=np.uint8)
    strip, wide = picture[-max(4, len(picture) // 24) :], picture.shape[1]
    strip[:] = _EMPTY
    for place, state in enumerate(states, STEPS - len(states)):
        left, right = place * wide // STEPS, (place + 1) * wide // STEPS
        strip[:, left : max(left + 1, right)] = STATES[state][0]
    return picture
