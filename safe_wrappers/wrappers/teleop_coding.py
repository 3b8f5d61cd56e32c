"""How commands and forces are written into packets: as they are, or with their energy paid for."""

import heapq
import math
from typing import Any, Literal, NamedTuple

import numpy as np

from safe_wrappers.checks import Array, positive
from safe_wrappers.control.teleop.passivity import ChannelLedger, effort_and_outgoing, port_energy, to_waves
from safe_wrappers.control.teleop.wave_line import WaveLine
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import refuse_changed_actions
from safe_wrappers.wrappers.layer import Env
from safe_wrappers.wrappers.teleop import Packet, Port, PortReading

Coding = Literal["plain", "wave"]


class Up(NamedTuple):
    """What goes from the operator to the machine."""

    action: Any  # as the operator gave it
    seen_s: float  # when the image was taken that it was made from, s
    extra: Any  # what the coding adds


class Down(NamedTuple):
    """What comes back."""

    observation: Any  # the env's
    taken_s: float  # when, s
    extra: Any  # what the coding adds


Order = tuple[Array | None, float]
"""The flow that replaces the port's entries of the command (None: none does); when its image was taken, s."""
Given = tuple[Array, Array]
"""Effort and flow with which the channel acted on the machine in one tick, shapes (m,)."""


class PlainCoding:
    """Actions and observations as they are; the base of the others.

    In each tick of `tick_s`, in this order: `near` (the operator moves), `sent`, `far` (what arrived is decoded), the
    env's step, `settle` (what truly happened), `sent`, `shown`. Without a reading of a port no energies are known.
    """

    def __init__(self, reading: PortReading | None, tick_s: float) -> None:
        self._reading, self._tick_s = reading, tick_s

    def reset(self, observation: Any) -> None:
        """A new episode, whose first observation the operator knows."""
        self._seen_s = 0.0
        self.ledger = ChannelLedger()
        if self._reading is not None:
            self._reading.reset(observation)
            self._still = np.zeros(self._reading.effort.size)

    def near(self, flow: Array | None) -> Any:
        """The operator moves with this flow, or is not there; returns what the packet up carries besides."""
        return None

    def sent(self, up: bool, sequence: int, extra: Any, lost: bool) -> None:
        """A packet left, up or down."""

    def far(self, arrived: list[Packet], newest: Up | None) -> Order:
        """Decode what has arrived in this tick."""
        if newest is not None:
            self._seen_s = newest.seen_s
        return None, self._seen_s

    def settle(self, flow: Array, observation: Any, obeyed: bool) -> tuple[Any, Given | None]:
        """After the env's step with a flow (m,): what the packet down carries, and what the machine was given.

        Where the operator was not obeyed, the channel's far port was still.
        """
        if self._reading is None:
            return None, None
        acted = self._reading.acted(flow, observation)
        return None, (acted, flow) if obeyed else (self._still, self._still)

    def shown(self, arrived: list[Packet], observation: Any) -> Any:
        """The observation that the operator gets, with the effort felt in this tick."""
        return observation

    def account(self, moved: Array | None, shown: Any, given: Given) -> None:
        """Add up a tick's energies: of the operator's flow (m,), None if absent, and at the machine."""
        assert self._reading is not None
        felt = self._reading.of(shown)
        moved = np.zeros_like(felt) if moved is None else moved
        self.ledger.add(felt, moved, *given, self._tick_s, self.stored_j)

    @property
    def stored_j(self) -> float:
        """Energy on its way, J."""
        return 0.0


class WaveCoding(PlainCoding):
    """Flow and effort as waves (`impedance` in N s/m), each of which pays for what it does at the other end."""

    def __init__(self, reading: PortReading, tick_s: float, impedance: float) -> None:
        super().__init__(reading, tick_s)
        self._port, self._impedance = reading, impedance

    def reset(self, observation: Any) -> None:
        super().reset(observation)
        m = self._still.size
        self._up, self._down = (WaveLine(self._tick_s, m) for _ in range(2))
        self._back: list[tuple[int, Array]] = []
        self._waiting: list[tuple[int, float]] = []
        self._incoming = self._felt = self._still
        self._owed_j = 0.0

    def near(self, flow: Array | None) -> Any:
        incoming = self._down.deliver(self._back)  # while the operator is away, it ends there
        self._back = []
        if flow is None:
            self._felt = self._still
            return None
        self._felt, outgoing = effort_and_outgoing(flow, incoming, self._impedance)
        return outgoing

    def sent(self, up: bool, sequence: int, extra: Any, lost: bool) -> None:
        line = self._up if up else self._down
        line.send(extra, sequence)
        if lost:
            line.lose(sequence)

    def far(self, arrived: list[Packet], newest: Up | None) -> Order:
        wave = self._up.deliver([(packet.sequence, packet.load.extra) for packet in arrived])
        # Seen as late as the wave that is put out now, or the last one.
        for packet in arrived:
            heapq.heappush(self._waiting, (packet.sequence, packet.load.seen_s))
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

    def settle(self, flow: Array, observation: Any, obeyed: bool) -> tuple[Any, Given | None]:
        _, given = super().settle(flow, observation, obeyed)
        assert given is not None
        if (
            not obeyed
        ):  # a still port absorbs the wave; reflected ones would pile up in the channel without bound
            return self._still, given
        acted, moved = given
        _, outgoing = to_waves(acted, moved, self._impedance)
        # Where the machine saturates, or a filter inside has changed the flow, the two waves do not match.
        left = self._energy(self._incoming) - port_energy(acted, moved, self._tick_s)
        energy = self._energy(outgoing)
        if left < 0.0:
            self._owed_j -= left
            outgoing = np.zeros_like(outgoing)
        elif energy > left:
            outgoing = outgoing * (math.sqrt(left / energy) * (1.0 - 1e-15))
        return outgoing, given

    def shown(self, arrived: list[Packet], observation: Any) -> Any:
        self._back += [(packet.sequence, packet.load.extra) for packet in arrived]
        return self._port.replaced(observation, self._felt)

    @property
    def stored_j(self) -> float:
        # Of waves that have arrived and were not put out yet, too.
        return sum(line.in_flight_j + line.reserve_j for line in (self._up, self._down))

    def _energy(self, wave: Array) -> float:
        return 0.5 * port_energy(wave, wave, self._tick_s)


def coding_from(
    env: Env, port: Port | None, tick_s: float, coding: Coding, impedance: float | None
) -> PlainCoding:
    """The coding that a channel's arguments ask for; an error if they do not go together or a port is missing."""
    reading = None if port is None else PortReading(env, port)
    if coding == "plain":
        if impedance is not None:
            raise ConfigurationError(f'impedance is for coding="wave"; got {impedance!r} with plain coding')
        return PlainCoding(reading, tick_s)
    if reading is None:
        published = "port_flow, port_effort_observed, port_feedthrough and port_effort_acted"
        raise ConfigurationError(f'coding="wave" needs a port: {env.unwrapped!r} publishes no {published}')
    refuse_changed_actions(env)
    if impedance is None:
        raise ConfigurationError('coding="wave" needs an impedance, in N s/m')
    return WaveCoding(reading, tick_s, positive("impedance", impedance, "N s/m"))
