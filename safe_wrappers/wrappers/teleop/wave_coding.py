"""Flow and effort as waves that pay for what they do; and which coding a channel's arguments ask for."""

import heapq
import math
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import non_negative, positive
from safe_wrappers.control.teleop.passivity import effort_and_outgoing, to_waves
from safe_wrappers.control.teleop.port_checks import port_energy
from safe_wrappers.control.teleop.wave_line import Rule, WaveLine
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import refuse_changed_actions
from safe_wrappers.wrappers.teleop.coding import Coding, Given, Order, PaidCoding, Passivity, PlainCoding, Up
from safe_wrappers.wrappers.teleop.link import Packet
from safe_wrappers.wrappers.teleop.port import PortReading, TeleopPort

Array = NDArray[np.float64]

_STORAGE_J: Final = 0.02
"""What each end of a passivity controller may give out unpaid, unless it is said."""


class WaveCoding(PlainCoding):
    """Flow and effort as waves, each of which pays for what it does at the other end.

    Args:
        reading: See `PlainCoding`; needed.
        tick_s: s.
        impedance: N s/m.
        rule: Of both `WaveLine`s.
    """

    def __init__(self, reading: PortReading, tick_s: float, impedance: float, rule: Rule) -> None:
        super().__init__(reading, tick_s)
        self._port, self._impedance, self._rule = reading, impedance, rule

    def reset(self, observation: Any) -> None:
        """As `PlainCoding.reset`."""
        super().reset(observation)
        m = self._still.size
        self._up, self._down = (WaveLine(self._tick_s, self._rule, m) for _ in range(2))
        self._back: list[tuple[int, Array]] = []
        self._waiting: list[tuple[int, float]] = []
        self._incoming = self._felt = self._still
        self._owed_j = 0.0

    def near(self, flow: Array | None) -> Any:
        """As `PlainCoding.near`; a wave that comes back while the operator is away ends there."""
        incoming = self._down.deliver(self._back)
        self._back = []
        if flow is None:
            self._felt = self._still
            return None
        self._felt, outgoing = effort_and_outgoing(flow, incoming, self._impedance)
        return outgoing

    def sent_up(self, sequence: int, extra: Any, lost: bool) -> None:
        """As `PlainCoding.sent_up`."""
        self._up.send(extra, sequence)
        if lost:
            self._up.lose(sequence)

    def far(self, arrived: list[Packet], newest: Up | None, flow: Array | None) -> Order:
        """As `PlainCoding.far`; it asks the waves alone."""
        wave = self._up.deliver([(packet.sequence, packet.load.extra) for packet in arrived])
        self._note_age(arrived, newest)
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
        return Order(decoded, self._seen_s)

    def settle(self, flow: Array, observation: Any, obeyed: bool) -> tuple[Any, Given | None]:
        """As `PlainCoding.settle`; a port that is still, because the brake acts, swallows the wave.

        Thrown back, as by a locked tool, waves of a hand that does not give way would pile up without bound in the
        channel, and come out when authority is given back.
        """
        _, given = super().settle(flow, observation, obeyed)
        assert given is not None
        if not obeyed:
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

    def sent_down(self, sequence: int, extra: Any, lost: bool) -> None:
        """As `PlainCoding.sent_down`."""
        self._down.send(extra, sequence)
        if lost:
            self._down.lose(sequence)

    def shown(self, arrived: list[Packet], observation: Any) -> Any:
        """As `PlainCoding.shown`: what the operator felt stands where the machine's effort was."""
        self._back += [(packet.sequence, packet.load.extra) for packet in arrived]
        return self._port.replaced(observation, self._felt)

    @property
    def stored_j(self) -> float:
        """Energy on its way, and of waves that have arrived and were not put out yet, J."""
        return sum(line.in_flight_j + line.reserve_j for line in (self._up, self._down))

    def _energy(self, wave: Array) -> float:
        return 0.5 * port_energy(wave, wave, self._tick_s)

    def _note_age(self, arrived: list[Packet], newest: Up | None) -> None:
        """How old the wave is that is put out now; the last one's age goes on while there is none."""
        if self._rule != "queue":
            if newest is not None:
                self._seen_s = newest.seen_s
            return
        for packet in arrived:
            heapq.heappush(self._waiting, (packet.sequence, packet.load.seen_s))
        if self._waiting:
            self._seen_s = heapq.heappop(self._waiting)[1]


def coding_from(
    env: gym.Env[Any, Any],
    port: TeleopPort | None,
    tick_s: float,
    coding: Coding,
    impedance: float | None,
    passivity: Passivity,
    damping_limit: float | None,
    storage_j: float | None,
    rule: Rule,
) -> PlainCoding:
    """The coding that a channel's arguments ask for.

    Raises:
        ConfigurationError: Arguments that do not go together, or a port that is missing.
    """
    if passivity == "none" and not (damping_limit is None and storage_j is None):
        raise ConfigurationError('damping_limit and storage_j are for passivity="controller"')
    storage_j = non_negative("storage_j", _STORAGE_J if storage_j is None else storage_j, "J")
    if damping_limit is not None:
        damping_limit = positive("damping_limit", damping_limit, "N")
    if coding == "wave" and passivity == "controller":
        raise ConfigurationError(
            'waves pay for their energy already: passivity="controller" is for plain coding'
        )
    if coding == "plain" and impedance is not None:
        raise ConfigurationError(f'impedance is for coding="wave"; got {impedance!r} with plain coding')
    reading = None if port is None else PortReading(env, port)
    if coding == "plain" and passivity == "none":
        return PlainCoding(reading, tick_s)
    if reading is None:
        what = 'coding="wave"' if coding == "wave" else 'passivity="controller"'
        raise ConfigurationError(
            f"{what} needs a port, and {env.unwrapped!r} publishes none: say which entries of the action are a flow "
            'and which of the observation its effort, port={"flow": [0, 1], "effort": [4, 5]}'
        )
    refuse_changed_actions(env)
    if coding == "plain":
        return PaidCoding(reading, tick_s, damping_limit, storage_j)
    if impedance is None:
        raise ConfigurationError('coding="wave" needs an impedance, in N s/m')
    return WaveCoding(reading, tick_s, positive("impedance", impedance, "N s/m"), rule)
