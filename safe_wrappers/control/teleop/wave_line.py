"""One direction of a wave channel over a network with delay, jitter, reordering and loss.

A wave sent for one tick carries the energy `|u|^2 / 2 * tick`. The channel stays passive if the energy put out never
exceeds the energy that has arrived and was not put out before. So every wave that arrives is put out once, one per
tick, in the order of sending; zero while there is none. The delay grows to that of the latest packet.

Source: appendix "Passivity preservation via wave variables", extended from a fixed delay.
"""

import heapq
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, positive, whole_number
from safe_wrappers.control.teleop.passivity import port_energy, port_vector


class WaveLine:
    """Energy account of one direction: `send` notes what leaves, `deliver` takes what arrives. It carries no data.

    Always ``put_in_j = put_out_j + in_flight_j + reserve_j + lost_j``, none of them negative.

    Args:
        time_s: The tick, duration of every wave sent or put out, s, > 0.
        components: m, of a wave, at least 1.

    Attributes:
        put_in_j: Energy of all waves sent, J.
        put_out_j: Energy of all waves put out, J.
        lost_j: Energy that will never come out, J.
    """

    def __init__(self, time_s: float, components: int = 1) -> None:
        self._time = positive("time_s", time_s, "s")
        self._components = whole_number("components", components, 1)
        self._flying: dict[int, float] = {}
        self._queue: list[tuple[int, float, tuple[float, ...]]] = []
        self.put_in_j = self.put_out_j = self.lost_j = 0.0

    @property
    def in_flight_j(self) -> float:
        """Energy of the packets that have neither arrived nor been declared lost, J."""
        return math.fsum(self._flying.values())

    @property
    def reserve_j(self) -> float:
        """Energy that has arrived and was not put out yet, J."""
        return math.fsum(energy for _, energy, _ in self._queue)

    def send(self, wave: ArrayLike, sequence: int) -> None:
        """Note a finite wave that leaves, sqrt(W), shape (m,) or a number; each has a sequence number of its own."""
        energy = self._energy(port_vector("wave", wave))
        self._flying[sequence] = energy
        self.put_in_j += energy

    def lose(self, sequence: int) -> None:
        """Declare a packet lost; its later arrival is ignored. Until then it counts as in flight."""
        self.lost_j += self._flying.pop(sequence)

    def deliver(self, packets: Iterable[tuple[int, ArrayLike]]) -> Array:
        """The wave put out during this tick, sqrt(W), shape (m,). Call it once per tick, arrivals or not.

        Args:
            packets: Arrivals since the last tick, (sequence, wave) in any order. What is not in flight is ignored.
        """
        arrived = [(sequence, port_vector("wave", given)) for sequence, given in packets]
        for sequence, wave in arrived:
            if sequence in self._flying:
                # The energy as sent counts, not that of the received wave.
                entry = sequence, self._flying.pop(sequence), tuple(wave.tolist())
                heapq.heappush(self._queue, entry)
        if not self._queue:
            return np.zeros(self._components)
        _, available, values = heapq.heappop(self._queue)
        put_out, energy = self._affordable(np.array(values), available)
        self.put_out_j += energy
        self.lost_j += available - energy
        return put_out

    def _affordable(self, wave: Array, available: float) -> tuple[Array, float]:
        """The wave, scaled down to the available energy where needed, and its energy, never above it."""
        energy = self._energy(wave)
        shrink = 1.0
        while energy > available:
            # Rounding may leave the first try slightly above.
            shrink *= 1.0 - 2.0**-50
            scaled = wave * (math.sqrt(available / energy) * shrink)
            wave, energy = scaled, self._energy(scaled)
        return wave, energy

    def _energy(self, wave: Array) -> float:
        return 0.5 * port_energy(wave, wave, self._time)
