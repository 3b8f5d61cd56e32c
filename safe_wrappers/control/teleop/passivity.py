"""Energy at a port: the ledger of a channel, wave variables.

Source: appendix "Passivity and Energy-Bounded Interaction". A port has an effort F (N or N m) and a flow v (m/s or
rad/s); their product is power. A channel is passive when no more energy comes out than was stored at the start and
went in; the wave transform keeps that for a *fixed* delay only. A sum of samples is the integral only if one of the
two is held over the interval and the other is its mean; a product of two samples is an estimate.

What is not finite raises `ConfigurationError`.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays, float_array, positive
from safe_wrappers.errors import ConfigurationError


def to_waves(effort: ArrayLike, flow: ArrayLike, impedance: float) -> tuple[Array, Array]:
    """The wave transform, `u = (F + b v) / sqrt(2 b)` and `w = (F - b v) / sqrt(2 b)` (equation 3), sqrt(W).

    Their power `(|u|^2 - |w|^2) / 2` is `F.v`.

    Args:
        effort: F, N, shape (..., m), or a number.
        flow: v, m/s, of the same shape, positive together with F into the component that u goes into.
        impedance: b > 0, N s/m.
    """
    f, v = finite_arrays(effort=effort, flow=flow)
    b = positive("impedance", impedance, "N s/m")
    root = math.sqrt(2.0 * b)
    return (f + b * v) / root, (f - b * v) / root


def effort_and_outgoing(flow: ArrayLike, incoming: ArrayLike, impedance: float) -> tuple[Array, Array]:
    """The operator's side: effort F and outgoing wave u for a known flow and the incoming wave w.

    Args:
        flow: v, m/s, shape (..., m), or a number.
        incoming: w, sqrt(W), of the same shape.
        impedance: b > 0, N s/m.
    """
    v, w = finite_arrays(flow=flow, incoming=incoming)
    b = positive("impedance", impedance, "N s/m")
    root = math.sqrt(2.0 * b)
    return b * v + root * w, root * v + w


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
        into = port_energy(port_vector("effort_m", effort_m), port_vector("flow_m", flow_m), time_s)
        out = port_energy(port_vector("effort_s", effort_s), port_vector("flow_s", flow_s), time_s)
        self.net_j += into - out
        self.created_j = max(self.created_j, stored_j - self.net_j)


def port_vector(name: str, value: ArrayLike) -> Array:
    """One quantity of a port as (m,); a number is (1,). `port_energy` checks that it is finite."""
    vector = float_array(name, value)
    if vector.ndim > 1 or vector.size == 0:
        raise ConfigurationError(f"expected {name} as a number or of shape (m,), got {vector.shape}")
    return vector.reshape(-1)


def port_energy(effort: Array, flow: Array, time_s: float) -> float:
    """`F.v dt`, J, of effort and flow (m,); a product that is not finite is refused."""
    if effort.shape != flow.shape:
        raise ConfigurationError(
            f"effort and flow of a port have one shape, got {effort.shape} and {flow.shape}"
        )
    # The product is checked instead of both factors, which saves time at every tick.
    with np.errstate(over="ignore", invalid="ignore"):
        energy = float(effort @ flow) * time_s
    if not math.isfinite(energy):
        raise ConfigurationError(f"effort, flow and so their product must be finite; got {effort}, {flow}")
    return energy
