"""Energy at a port: the ledger of a channel, wave variables.

Source: appendix "Passivity and Energy-Bounded Interaction". A port has an effort F (N or N m) and a flow v (m/s or
rad/s); their product is power. A channel is passive when no more energy comes out than was stored at the start and
went in; the wave transform keeps that for a *fixed* delay only. A sum of samples is the integral only if one of the
two is held over the interval and the other is its mean; a product of two samples is an estimate.

Efforts, flows and waves are numbers or arrays of shape (m,); functions without memory also take batch axes, (..., m).
What is not finite raises `ConfigurationError`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.teleop.port_checks import (
    RunningSum,
    energy_j,
    port_energy,
    port_vectors,
    positive,
    same_shape,
)

_EPS = float(np.finfo(np.float64).eps)


class Waves(NamedTuple):
    """A pair of waves, shape (..., m), sqrt(W): u into the component, w out of it."""

    u: Array
    w: Array


class EffortAndWave(NamedTuple):
    """Effort F, N, and outgoing wave, sqrt(W), of a side whose flow is known; shape (..., m)."""

    effort: Array
    outgoing: Array


def to_waves(effort: ArrayLike, flow: ArrayLike, impedance: float) -> Waves:
    """The wave transform, `u = (F + b v) / sqrt(2 b)` and `w = (F - b v) / sqrt(2 b)` (equation 3).

    Their power `(|u|^2 - |w|^2) / 2` is `F.v`.

    Args:
        effort: F, N, shape (..., m), or a number.
        flow: v, m/s, of the same shape, positive together with F into the component that u goes into.
        impedance: b > 0, N s/m.
    """
    f, v = same_shape(effort=effort, flow=flow)
    b = positive("impedance", impedance)
    root = math.sqrt(2.0 * b)
    return Waves(np.asarray((f + b * v) / root), np.asarray((f - b * v) / root))


def effort_and_outgoing(flow: ArrayLike, incoming: ArrayLike, impedance: float) -> EffortAndWave:
    """The operator's side: effort F and outgoing wave u for a known flow and the incoming wave w.

    Args:
        flow: v, m/s, shape (..., m), or a number.
        incoming: w, sqrt(W), of the same shape.
        impedance: b > 0, N s/m.
    """
    v, w = same_shape(flow=flow, incoming=incoming)
    b = positive("impedance", impedance)
    root = math.sqrt(2.0 * b)
    return EffortAndWave(np.asarray(b * v + root * w), np.asarray(root * v + w))


class ChannelLedger:
    """Energy of a two-port channel with any coding, `E_ch(T) - E_ch(0) <= integral of (P_m - P_s) dt`.

    F.v is positive into the channel at the port m (the operator's), and out of it at s (the remote one).

    Args:
        initial_storage_j: E_ch(0), or a bound on it, at least 0 J.
    """

    def __init__(self, initial_storage_j: float = 0.0) -> None:
        self._initial = energy_j("initial_storage_j", initial_storage_j)
        self._net = RunningSum()
        self._created = self._rounding = 0.0

    def add(
        self,
        effort_m: ArrayLike,
        flow_m: ArrayLike,
        effort_s: ArrayLike,
        flow_s: ArrayLike,
        time_s: float,
        stored_j: float | None = None,
    ) -> None:
        """Account one interval of `time_s` > 0.

        Efforts (N) and flows (m/s) at the operator's port m and the remote port s are numbers, or of shape (m,) at
        each port. `stored_j` is the energy in flight at its end, if known, at least 0; None counts as 0.
        """
        f_m, v_m = port_vectors(effort_m=effort_m, flow_m=flow_m)
        f_s, v_s = port_vectors(effort_s=effort_s, flow_s=flow_s)
        effort, flow = np.concatenate([f_m, -f_s]), np.concatenate([v_m, v_s])
        time = positive("time_s", time_s)
        stored = 0.0 if stored_j is None else energy_j("stored_j", stored_j)
        self._net.add(port_energy(effort, flow, time))
        # The storage is computed from waves that are rounded at every step, so its rounding counts each time.
        exchanged = float(np.abs(effort) @ np.abs(flow)) * time
        self._rounding += (effort.size + 4) * _EPS * (exchanged + stored)
        self._created = max(self._created, stored - self._net.value - self._initial)

    @property
    def net_j(self) -> float:
        """Integral of P_m - P_s, J: net energy into the channel."""
        return self._net.value

    @property
    def stored_j(self) -> float:
        """Largest possible energy in the channel now, `E_ch(0) + net`, J; below 0: not passive."""
        return self._initial + self._net.value

    @property
    def created_j(self) -> float:
        """Largest excess so far of energy out (or in flight) over energy in and initial storage, J."""
        return self._created

    @property
    def passive(self) -> bool:
        """Whether it has created no energy so far, to rounding."""
        return self._created <= self._rounding + 4.0 * _EPS * self._initial
