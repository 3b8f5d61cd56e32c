"""Ports of effort and flow, and how both are written into packets with their energy paid for."""

import heapq
import math
from typing import Any, NamedTuple

import numpy as np

from safe_wrappers.control.teleop import WaveLine, effort_and_outgoing, port_energy, to_waves
from safe_wrappers.errors import Array
from safe_wrappers.wrappers.layer import Env


class Packet(NamedTuple):
    """What goes over the network; packets compare by their numbers."""

    sequence: int  # on its line, from 0
    content: Any  # the operator's action, or the env's observation
    made_s: float  # when the image was taken that it was made from, or that it is, s
    wave: Array | None  # what the coding adds


class Port:
    """A pair of effort and flow whose product is power, as an env publishes it.

    Attributes:
        flow: Entries of the action, in m/s (or rad/s).
        feedthrough: Change of the effort at once per change of the flow, N s/m: a damper before the machine.
        effort: How the command pushes the machine at the present state and with the last command, N (or N m).
    """

    def __init__(self, env: Env) -> None:
        names = "port_flow", "port_effort_observed"
        self.flow, self._shown = (list(env.get_wrapper_attr(name)) for name in names)
        self.feedthrough = float(env.get_wrapper_attr("port_feedthrough"))
        self._env = env

    def reset(self, observation: Array) -> None:
        """At rest, the effort as observed."""
        self._last_flow = np.zeros(len(self.flow))
        self.effort = self.of(observation)

    @property
    def base(self) -> Array:
        """The effort without flow, N."""
        return self.effort - self.feedthrough * self._last_flow

    def acted(self, flow: Array, observation: Array) -> Array:
        """The effort during the step that was made with this flow, as the env publishes it, N."""
        self._last_flow = flow
        self.effort = self.of(observation)
        return np.array(self._env.get_wrapper_attr("port_effort_acted"), dtype=np.float64)

    def of(self, observation: Array) -> Array:
        """The effort that an observation shows, N."""
        return np.asarray(observation[self._shown], dtype=np.float64)

    def replaced(self, observation: Array, effort: Array) -> Array:
        """An observation that shows another effort."""
        shown = np.array(observation)
        shown[self._shown] = effort
        return shown


class WaveCoding:
    """Flow and effort as waves (`impedance` in N s/m), each of which pays for what it does at the other end.

    In each tick of `tick_s`, in this order: `near` (the operator moves), `sent`, `far` (what arrived is decoded), the
    env's step, `settle` (what truly happened), `sent`, `felt`.
    """

    def __init__(self, port: Port, tick_s: float, impedance: float) -> None:
        self._port, self._tick_s, self._impedance = port, tick_s, impedance

    def reset(self) -> None:
        """A new episode."""
        size = len(self._port.flow)
        self._still = np.zeros(size)
        self._up, self._down = (WaveLine(self._tick_s, size) for _ in range(2))
        self._back: list[Packet] = []
        self._waiting: list[tuple[int, float]] = []
        self._incoming = self._felt = self._still
        self._seen_s = self._owed_j = 0.0

    def near(self, flow: Array | None) -> Array | None:
        """The wave in the packet up, of an operator who moves with this flow; None who is not there."""
        incoming = self._delivered(self._down, self._back)  # while the operator is away, it ends there
        self._back = []
        if flow is None:
            self._felt = self._still
            return None
        self._felt, outgoing = effort_and_outgoing(flow, incoming, self._impedance)
        return outgoing

    def sent(self, up: bool, sequence: int, wave: Any, lost: bool) -> None:
        """A packet left, up or down."""
        line = self._up if up else self._down
        line.send(wave, sequence)
        if lost:
            line.lose(sequence)

    def far(self, arrived: list[Packet]) -> tuple[Array, float]:
        """The flow that the command gets by what has arrived; when its image was taken, s."""
        wave = self._delivered(self._up, arrived)
        # Seen as late as the wave that is put out now, or the last one.
        for packet in arrived:
            heapq.heappush(self._waiting, (packet.sequence, packet.made_s))
        if self._waiting:
            self._seen_s = heapq.heappop(self._waiting)[1]
        # What the machine took beyond what had arrived is paid first.
        energy = self._energy(wave)
        paid = min(self._owed_j, energy)
        if paid > 0.0:
            self._owed_j -= paid
            wave = wave * math.sqrt((energy - paid) / energy)
        self._incoming = wave
        b = self._impedance
        # The effort answers the flow at once where there is a damper, so both are solved for together.
        decoded = (math.sqrt(2.0 * b) * wave - self._port.base) / (b + self._port.feedthrough)
        return decoded, self._seen_s

    def settle(self, effort: Array, flow: Array, obeyed: bool) -> Array:
        """The wave in the packet down, of the effort and the flow with which the channel acted on the machine."""
        if not obeyed:
            # A still port absorbs the wave; reflected ones would pile up in the channel without bound.
            return self._still
        _, outgoing = to_waves(effort, flow, self._impedance)
        # Where the machine saturates, or a filter inside has changed the flow, the two waves do not match.
        left = self._energy(self._incoming) - port_energy(effort, flow, self._tick_s)
        energy = self._energy(outgoing)
        if left < 0.0:
            self._owed_j -= left
            outgoing = np.zeros_like(outgoing)
        elif energy > left:
            outgoing = outgoing * (math.sqrt(left / energy) * (1.0 - 1e-15))
        return outgoing

    def felt(self, arrived: list[Packet]) -> Array:
        """The effort that the operator feels in this tick, in which these packets arrive."""
        self._back += arrived
        return self._felt

    @property
    def stored_j(self) -> float:
        """Energy on its way, of waves that have arrived and were not put out yet too, J."""
        return sum(line.in_flight_j + line.reserve_j for line in (self._up, self._down))

    def _delivered(self, line: WaveLine, arrived: list[Packet]) -> Array:
        return line.deliver([(packet.sequence, packet.wave) for packet in arrived])  # type: ignore[misc]

    def _energy(self, wave: Array) -> float:
        return 0.5 * port_energy(wave, wave, self._tick_s)
