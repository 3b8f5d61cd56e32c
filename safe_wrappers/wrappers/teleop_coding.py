"""Ports of effort and flow, and how both are written into packets with their energy paid for."""

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from safe_wrappers.control.teleop import effort_and_outgoing, port_energy, to_waves
from safe_wrappers.errors import Array
from safe_wrappers.wrappers.layer import Env


class Packet(NamedTuple):
    """What goes over the network."""

    content: Any  # the operator's action, or the env's observation
    made_s: float  # when the image was taken that it was made from, or that it is, s
    wave: Any = None  # what the coding adds, sqrt(W), shape (m,)
    energy_j: float = 0.0  # of the wave


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

    A wave u carries the energy `|u|^2 / 2 * tick_s`. Every wave that arrives is put out once, one per tick; zero
    while there is none. So no more energy comes out than has arrived, and the delay grows to that of the latest one.

    In each tick of `tick_s`, in this order: `near` (the operator moves), `far` (what arrived is decoded), the env's
    step, `settle` (what truly happened), `felt`.
    """

    def __init__(self, port: Port, tick_s: float, impedance: float) -> None:
        self._port, self._tick_s, self._impedance = port, tick_s, impedance

    def reset(self) -> None:
        """A new episode."""
        self._still = np.zeros(len(self._port.flow))
        self._up: deque[Packet] = deque()
        self._down: deque[Packet] = deque()
        self._incoming = self._felt = self._still
        self._seen_s = self._owed_j = 0.0

    def near(self, flow: Array | None) -> Array | None:
        """The wave in the packet up, of an operator who moves with this flow; None who is not there."""
        # While the operator is away, it ends there.
        incoming = self._down.popleft().wave if self._down else self._still
        if flow is None:
            self._felt = self._still
            return None
        self._felt, outgoing = effort_and_outgoing(flow, incoming, self._impedance)
        return outgoing

    def far(self, arrived: list[Packet]) -> tuple[Array, float]:
        """The flow that the command gets by what has arrived; when its image was taken, s."""
        self._up.extend(arrived)
        wave = self._still
        if self._up:  # seen as late as the wave that is put out now, or the last one
            _, self._seen_s, wave, _ = self._up.popleft()
        # What the machine took beyond what had arrived is paid first.
        energy = self.energy(wave)
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
        left = self.energy(self._incoming) - port_energy(effort, flow, self._tick_s)
        energy = self.energy(outgoing)
        if left < 0.0:
            self._owed_j -= left
            outgoing = np.zeros_like(outgoing)
        elif energy > left:
            outgoing = outgoing * (math.sqrt(left / energy) * (1.0 - 1e-15))
        return outgoing

    def felt(self, arrived: list[Packet]) -> Array:
        """The effort that the operator feels in this tick, in which these packets arrive."""
        self._down.extend(arrived)
        return self._felt

    @property
    def waiting(self) -> list[Packet]:
        """What has arrived and was not put out yet."""
        return [*self._up, *self._down]

    def energy(self, wave: Array) -> float:
        """Of a wave, J."""
        return 0.5 * port_energy(wave, wave, self._tick_s)
