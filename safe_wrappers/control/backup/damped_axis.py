"""One axis of a damped point mass under a held force: its exact step, and braking.

A physics step maps speed v and control u to `v' = decay v + gain u` and moves by `timestep v'` (MuJoCo's
semi-implicit Euler step with implicit joint damping). A control is held for `substeps` of them, so a hold is linear:
`v_end = A v + B u`, `x_end = x + P v + Q u`. Braking is the full opposing control, and in the last hold `-A v / B`,
which ends at rest.
"""

import math
from typing import NamedTuple

from safe_wrappers.control.compiled import compiled


class DampedAxis(NamedTuple):
    """Constants of one axis, made by `damped_axis`.

    Attributes:
        decay: Share of the speed that one physics step keeps without control, in (0, 1].
        gain: Speed that one physics step adds per control, m/s, > 0.
        timestep: Physics step, s.
        substeps: Physics steps per control step.
        low: Smallest control, < 0.
        high: Largest control, > 0.
        clip: Speed to which the env clips the motion at the start of every control step, m/s; inf for none.
        keep: A: share of the speed that one hold keeps.
        add: B: speed that one hold adds per control, m/s.
        drift: P: displacement in one hold per speed, s.
        shift: Q: displacement in one hold per control, m.
    """

    decay: float
    gain: float
    timestep: float
    substeps: int
    low: float
    high: float
    clip: float
    keep: float
    add: float
    drift: float
    shift: float


def damped_axis(
    decay: float,
    gain: float,
    timestep: float,
    substeps: int,
    low: float,
    high: float,
    clip: float = math.inf,
) -> DampedAxis:
    """The axis of these constants."""
    keep, add, drift, shift = 1.0, 0.0, 0.0, 0.0
    for _ in range(substeps):
        keep, add = decay * keep, decay * add + gain
        drift, shift = drift + timestep * keep, shift + timestep * add
    return DampedAxis(decay, gain, timestep, substeps, low, high, clip, keep, add, drift, shift)


@compiled
def clipped(axis: DampedAxis, v: float) -> float:
    """The speed after the env's clip."""
    return max(-axis.clip, min(v, axis.clip))


@compiled
def step(axis: DampedAxis, x: float, v: float, u: float) -> tuple[float, float]:
    """Position and speed at the end of a hold; `v` is already clipped."""
    u = max(axis.low, min(u, axis.high))
    return x + axis.drift * v + axis.shift * u, axis.keep * v + axis.add * u


@compiled
def brake(axis: DampedAxis, v: float) -> float:
    """The control that brakes fully, or just to rest within one hold; `v` is already clipped."""
    return max(axis.low, min(-axis.keep * v / axis.add, axis.high))
