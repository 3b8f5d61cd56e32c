"""Passivity over a network: wave variables, and the energy ledger of a channel.

Source: appendix "Passivity and Energy-Bounded Interaction". A port has an effort F (N or N m) and a flow v (m/s or
rad/s); their product is power. A channel is passive when no more energy comes out than was stored at the start and
went in; the wave transform keeps that for a *fixed* delay only. A sum of samples is the integral only if one of the
two is held over the interval and the other is its mean.

The energy at a port that is not finite raises `ConfigurationError`; waves are not checked by themselves.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import Array, ConfigurationError, float_array


def to_waves(effort: Array, flow: Array, impedance: float) -> tuple[Array, Array]:
    """The wave transform, `u = (F + b v) / sqrt(2 b)` and `w = (F - b v) / sqrt(2 b)` (equation 3), sqrt(W).

    Their power `(|u|^2 - |w|^2) / 2` is `F.v`.

    Args:
        effort: F, N, shape (..., m).
        flow: v, m/s, of the same shape, positive together with F into the component that u goes into.
        impedance: b > 0, N s/m.
    """
    root = math.sqrt(2.0 * impedance)
    return (effort + impedance * flow) / root, (effort - impedance * flow) / root


def effort_and_outgoing(flow: Array, incoming: Array, impedance: float) -> tuple[Array, Array]:
    """The operator's side: effort F, N, and outgoing wave u for a known flow, m/s, and the incoming wave w, sqrt(W).

    All are of one shape (..., m); the impedance b is in N s/m, > 0.
    """
    root = math.sqrt(2.0 * impedance)
    return impedance * flow + root * incoming, root * flow + incoming


def port_energy(effort: ArrayLike, flow: ArrayLike, time_s: float) -> float:
    """`F.v dt`, J, of effort and flow, each a number or of shape (m,); a product that is not finite is refused."""
    f, v = (float_array("effort and flow", given).reshape(-1) for given in (effort, flow))
    if f.shape != v.shape:
        raise ConfigurationError(f"effort and flow of a port have one shape, got {f.shape} and {v.shape}")
    # The product is checked instead of both factors, which saves time at every tick.
    with np.errstate(over="ignore", invalid="ignore"):
        energy = float(f @ v) * time_s
    if not math.isfinite(energy):
        raise ConfigurationError(f"effort, flow and so their product must be finite; got {f}, {v}")
    return energy


class ChannelLedger:
    """Energy of a two-port channel with any coding, `E_ch(T) - E_ch(0) <= integral of (P_m - P_s) dt`.

    F.v is positive into the channel at the port m (the operator's), and out of it at s (the remote one).

    Attributes:
        net_j: Integral of P_m - P_s, J: net energy into the channel.
        created_j: Largest excess so far of energy out (or in flight) over energy in, J; 0 is passive.
    """

    def __init__(self) -> None:
        self.net_j = self.created_j = 0.0

    def add(
        self,
        effort_m: ArrayLike,
        flow_m: ArrayLike,
        effort_s: ArrayLike,
        flow_s: ArrayLike,
        time_s: float,
        stored_j: float = 0.0,
    ) -> None:
        """Account one interval of `time_s` > 0.

        Efforts (N) and flows (m/s) at the operator's port m and the remote port s are numbers, or of shape (m,) at
        each port. `stored_j` is the energy in flight at its end, as far as it is known.
        """
        self.net_j += port_energy(effort_m, flow_m, time_s) - port_energy(effort_s, flow_s, time_s)
        self.created_j = max(self.created_j, stored_j - self.net_j)
