"""One direction of a wave channel over a network with delay, jitter, reordering and loss.

A wave sent for one tick carries the energy `|u|^2 / 2 * tick`. The channel stays passive if the energy put out never
exceeds the energy that has arrived and was not put out before. Three rules:

- ``"queue"``: every wave that arrives is put out once, one per tick, in the order of sending; zero while there is
  none. The delay grows to that of the latest packet.
- ``"hold"``: the newest wave that has arrived, scaled down to the reserve of energy. The wave's integral, and with it
  the position of the remote side, drifts.
- ``"zero"``: the sum of what arrives within the tick, scaled down to the energy that arrived; zero if nothing does.

Source: appendix "Passivity preservation via wave variables", extended from a fixed delay.
"""

import heapq
import math
from collections.abc import Iterable
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, whole_number
from safe_wrappers.control.teleop.port_checks import RunningSum, port_energy, port_vector, positive
from safe_wrappers.errors import ConfigurationError

Rule = Literal["queue", "hold", "zero"]


class WaveLine:
    """Energy account of one direction: `send` notes what leaves, `deliver` takes what arrives. It carries no data.

    Always ``put_in_j = put_out_j + in_flight_j + reserve_j + lost_j``, none of them negative.

    Args:
        time_s: The tick, duration of every wave sent or put out, s, > 0.
        rule: See above.
        components: m, of a wave, at least 1.
    """

    def __init__(self, time_s: float, rule: Rule = "queue", components: int = 1) -> None:
        self._time = positive("time_s", time_s)
        if rule not in get_args(Rule):
            raise ConfigurationError(f"rule must be one of {', '.join(get_args(Rule))}, got {rule!r}")
        self.rule: Rule = rule
        self._components = whole_number("components", components, 1)
        self._last_sent = -1
        self._flying: dict[int, float] = {}
        self._in_flight = RunningSum()
        self._queue: list[tuple[int, float, tuple[float, ...]]] = []
        self._queued = RunningSum()
        self._newest = -1
        self._held = np.zeros(self._components)
        self._reserve = 0.0
        self._put_in, self._put_out, self._lost = RunningSum(), RunningSum(), RunningSum()

    @property
    def put_in_j(self) -> float:
        """Energy of all waves sent, J."""
        return self._put_in.value

    @property
    def put_out_j(self) -> float:
        """Energy of all waves put out, J."""
        return self._put_out.value

    @property
    def in_flight_j(self) -> float:
        """Energy of the packets that have neither arrived nor been declared lost, J, at least 0."""
        return max(self._in_flight.value, 0.0)

    @property
    def reserve_j(self) -> float:
        """Energy that has arrived and may still be put out, J."""
        return max(self._queued.value, 0.0) if self.rule == "queue" else self._reserve

    @property
    def lost_j(self) -> float:
        """Energy that will never come out, J: of lost packets, and not used by the rule."""
        return self._lost.value

    def send(self, wave: ArrayLike, sequence: int) -> None:
        """Note a wave that leaves, sqrt(W), shape (m,) or a number.

        Raises:
            ConfigurationError: For a wave of another shape or not finite, and a sequence number that does not rise.
        """
        if sequence <= self._last_sent:
            raise ConfigurationError(f"sequence must rise, be at least 0; {sequence} after {self._last_sent}")
        energy = self._energy(self._wave(wave))
        self._last_sent = int(sequence)
        self._flying[self._last_sent] = energy
        self._in_flight.add(energy)
        self._put_in.add(energy)

    def lose(self, sequence: int) -> None:
        """Declare a packet lost; its later arrival is ignored. Until then it counts as in flight.

        Raises:
            ConfigurationError: If it is not in flight.
        """
        if sequence not in self._flying:
            raise ConfigurationError(f"packet {sequence} is not in flight, so it cannot get lost")
        self._lost.add(self._landed(sequence))

    def deliver(self, packets: Iterable[tuple[int, ArrayLike]]) -> Array:
        """The wave put out during this tick, sqrt(W), shape (m,). Call it once per tick, arrivals or not.

        Args:
            packets: Arrivals since the last tick, (sequence, wave) in any order. Duplicates are ignored.

        Raises:
            ConfigurationError: For a packet that was never sent, or a wave of another shape or not finite.
        """
        arrived = [(sequence, self._wave(given)) for sequence, given in packets]
        unknown = [sequence for sequence, _ in arrived if sequence > self._last_sent]
        if unknown:
            raise ConfigurationError(f"packets {unknown} arrived and were never sent")
        # The energy as sent counts, not that of the received wave.
        fresh = [(int(i), self._landed(i), wave) for i, wave in arrived if i in self._flying]
        if self.rule == "queue":
            return self._next_in_queue(fresh)
        none = np.zeros(self._components)
        wanted = sum((wave for *_, wave in fresh), none) if self.rule == "zero" else self._newest_of(fresh)
        available = self._reserve + math.fsum(energy for _, energy, _ in fresh)
        put_out, energy = self._affordable(wanted, available)
        self._put_out.add(energy)
        if self.rule == "zero":
            self._lost.add(available - energy)
        else:
            self._reserve = available - energy
        return put_out

    def _landed(self, sequence: int) -> float:
        """Take a packet out of flight; its energy."""
        energy = self._flying.pop(sequence)
        self._in_flight.add(-energy)
        if not self._flying:
            self._in_flight = RunningSum()  # exactly zero
        return energy

    def _next_in_queue(self, fresh: list[tuple[int, float, Array]]) -> Array:
        for sequence, energy, wave in fresh:
            heapq.heappush(self._queue, (sequence, energy, tuple(wave.tolist())))
            self._queued.add(energy)
        if not self._queue:
            return np.zeros(self._components)
        _, available, values = heapq.heappop(self._queue)
        self._queued.add(-available)
        if not self._queue:
            self._queued = RunningSum()
        put_out, energy = self._affordable(np.array(values), available)
        self._put_out.add(energy)
        self._lost.add(available - energy)
        return put_out

    def _newest_of(self, fresh: list[tuple[int, float, Array]]) -> Array:
        for sequence, _, wave in fresh:
            if sequence > self._newest:
                self._newest, self._held = sequence, wave
        return self._held

    def _affordable(self, wave: Array, available: float) -> tuple[Array, float]:
        """The wave, scaled down to the available energy where needed, and its energy, never above it."""
        energy = self._energy(wave)
        shrink = 1.0
        while energy > available:
            # Rounding may leave the first try slightly above.
            shrink *= 1.0 - 2.0**-50
            scaled = wave * (math.sqrt(available / energy) * shrink)
            wave, energy = scaled, self._energy(scaled)
        return np.array(wave), energy

    def _energy(self, wave: Array) -> float:
        return 0.5 * port_energy(wave, wave, self._time)

    def _wave(self, given: ArrayLike) -> Array:
        wave = port_vector("wave", given)
        if wave.size != self._components:
            raise ConfigurationError(f"expected a wave of {self._components} components, got {wave.size}")
        self._energy(wave)
        return wave.copy()
