"""Wave variables of a port with a known effort, and powers.

Source: appendix "Passivity and Energy-Bounded Interaction". Signs and units as in
`safe_wrappers.control.teleop.passivity`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.teleop.port_checks import positive, same_shape


class Port(NamedTuple):
    """A port's two quantities.

    Attributes:
        effort: F, N (or N m), shape (..., m).
        flow: v, m/s (or rad/s), shape (..., m).
    """

    effort: Array
    flow: Array


class FlowAndWave(NamedTuple):
    """What a side that knows its effort works out.

    Attributes:
        flow: v, m/s, shape (..., m).
        outgoing: The wave to be sent, sqrt(W), shape (..., m).
    """

    flow: Array
    outgoing: Array


def port_power(effort: ArrayLike, flow: ArrayLike) -> Array:
    """`F.v`, the power into the component, shape (...), W.

    Args:
        effort: N (or N m), shape (..., m), or a number.
        flow: m/s (or rad/s), of the same shape.
    """
    f, v = same_shape(effort=effort, flow=flow)
    return np.asarray(f * v if f.ndim == 0 else (f * v).sum(axis=-1))


def from_waves(u: ArrayLike, w: ArrayLike, impedance: float) -> Port:
    """Its inverse, `F = sqrt(b / 2) (u + w)` and `v = (u - w) / sqrt(2 b)`.

    Args:
        u: Wave into the component, sqrt(W), shape (..., m), or a number.
        w: Wave out of it, of the same shape.
        impedance: b > 0, N s/m.
    """
    into, out = same_shape(u=u, w=w)
    b = positive("impedance", impedance)
    return Port(np.asarray(math.sqrt(b / 2.0) * (into + out)), np.asarray((into - out) / math.sqrt(2.0 * b)))


def flow_and_outgoing(effort: ArrayLike, incoming: ArrayLike, impedance: float) -> FlowAndWave:
    """The remote side: it knows its effort and the wave u that arrived, and moves with v while it sends w back.

    `v = (sqrt(2 b) u - F) / b` and `w = sqrt(2 / b) F - u`.

    Args:
        effort: F, with which the channel pushes what is behind it, N, shape (..., m), or a number.
        incoming: u, sqrt(W), of the same shape.
        impedance: b > 0, N s/m.
    """
    f, u = same_shape(effort=effort, incoming=incoming)
    b = positive("impedance", impedance)
    return FlowAndWave(
        np.asarray((math.sqrt(2.0 * b) * u - f) / b), np.asarray(math.sqrt(2.0) / math.sqrt(b) * f - u)
    )


def wave_power(u: ArrayLike, w: ArrayLike) -> Array:
    """`|u|^2 / 2 - |w|^2 / 2`, the power into the component, shape (...), W.

    Args:
        u: Wave into it, sqrt(W), shape (..., m), or a number.
        w: Wave out of it, of the same shape.
    """
    into, out = same_shape(u=u, w=w)
    power = 0.5 * (into - out) * (into + out)
    return np.asarray(power if power.ndim == 0 else power.sum(axis=-1))
