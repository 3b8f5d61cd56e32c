"""How commands and forces are written into packets: as they are, or with their energy paid for."""

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.teleop.passivity import ChannelLedger
from safe_wrappers.control.teleop.passivity_control import EnergyReference
from safe_wrappers.control.teleop.port_checks import RunningSum, port_energy
from safe_wrappers.wrappers.teleop.link import Packet
from safe_wrappers.wrappers.teleop.port import PortReading

Array = NDArray[np.float64]

Coding = Literal["plain", "wave"]
Passivity = Literal["none", "controller"]


class Up(NamedTuple):
    """What goes from the operator to the machine.

    Attributes:
        action: As the operator gave it.
        seen_s: When the image was taken that it was made from, s.
        extra: What the coding adds.
    """

    action: Any
    seen_s: float
    extra: Any


class Down(NamedTuple):
    """What comes back.

    Attributes:
        observation: The env's.
        taken_s: When, s.
        extra: What the coding adds.
    """

    observation: Any
    taken_s: float
    extra: Any


class Order(NamedTuple):
    """What is to be executed at the machine.

    Attributes:
        flow: To replace the port's entries of what would be executed; None: as it is.
        seen_s: When the image was taken that it was made from.
    """

    flow: Array | None
    seen_s: float


class Given(NamedTuple):
    """Effort and flow with which the channel acted on the machine in one tick, shapes (m,)."""

    effort: Array
    flow: Array


class PlainCoding:
    """Actions and observations as they are; the base of the others.

    In each tick, in this order: `near` (the operator moves), `sent_up`, `far` (what arrived is decoded), the env's
    step, `settle` (what truly happened), `sent_down`, `shown`.

    Args:
        reading: Of the machine's port; None: there is none, and no energies are known.
        tick_s: s.
    """

    storage_j = 0.0
    """What each end may give out unpaid, J."""

    def __init__(self, reading: PortReading | None, tick_s: float) -> None:
        self._reading, self._tick_s = reading, tick_s

    def reset(self, observation: Any) -> None:
        """A new episode, whose first observation the operator knows."""
        self._seen_s = 0.0
        self.ledger = ChannelLedger(2.0 * self.storage_j)
        self.energy_in, self.energy_out = RunningSum(), RunningSum()
        if self._reading is not None:
            self._reading.reset(observation)
            self._still = np.zeros(self._reading.effort.size)

    def near(self, flow: Array | None) -> Any:
        """The operator moves with this flow, or is not there; returns what the packet up carries besides."""
        return None

    def sent_up(self, sequence: int, extra: Any, lost: bool) -> None:
        """The packet left."""

    def far(self, arrived: list[Packet], newest: Up | None, flow: Array | None) -> Order:
        """Decode what has arrived.

        Args:
            arrived: In this tick.
            newest: The newest command that ever has.
            flow: What would be executed as it is, shape (m,); None: nothing of the operator's.
        """
        if newest is not None:
            self._seen_s = newest.seen_s
        return Order(None, self._seen_s)

    def settle(self, flow: Array, observation: Any, obeyed: bool) -> tuple[Any, Given | None]:
        """After the env's step: what the packet down carries besides, and what the machine was given.

        Args:
            flow: That was executed, shape (m,).
            observation: The env's new one.
            obeyed: Whether it was the operator's. If not, the channel's far port was still.
        """
        if self._reading is None:
            return None, None
        acted = self._reading.acted(flow, observation)
        return None, Given(acted, flow) if obeyed else Given(self._still, self._still)

    def sent_down(self, sequence: int, extra: Any, lost: bool) -> None:
        """The packet left."""

    def shown(self, arrived: list[Packet], observation: Any) -> Any:
        """The observation that the operator gets, from the newest one and all that has arrived in this tick.

        Its effort is the one against which the operator has moved in this tick.
        """
        return observation

    def account(self, moved: Array | None, shown: Any, given: Given) -> None:
        """Add up the energies of a tick at the two ports.

        Args:
            moved: The operator's flow, shape (m,); None: he is not there.
            shown: The observation that he gets.
            given: Effort and flow at the machine.
        """
        assert self._reading is not None
        felt = self._reading.of(shown)
        moved = np.zeros_like(felt) if moved is None else moved
        self.ledger.add(felt, moved, *given, self._tick_s, self.stored_j)
        self.energy_in.add(port_energy(felt, moved, self._tick_s))
        self.energy_out.add(port_energy(*given, self._tick_s))

    @property
    def stored_j(self) -> float:
        """Energy on its way, J."""
        return 0.0


class PaidCoding(PlainCoding):
    """Plain, but each end gives out no more energy than it has heard the other took in (`EnergyReference`).

    Args:
        reading: See `PlainCoding`; needed.
        tick_s: s.
        limit: Of the damping force at the operator's end, N; None: none.
        storage_j: What each end may give out beyond what it has heard of, J: the channel's initial storage is twice
            as much.
    """

    def __init__(self, reading: PortReading, tick_s: float, limit: float | None, storage_j: float) -> None:
        super().__init__(reading, tick_s)
        self._port, self._limit, self.storage_j = reading, limit, storage_j

    def reset(self, observation: Any) -> None:
        """As `PlainCoding.reset`."""
        super().reset(observation)
        near = EnergyReference("impedance", self.storage_j, self._limit)
        self._ends = near, EnergyReference("admittance", self.storage_j)
        self._late = self._felt = self._port.effort

    def near(self, flow: Array | None) -> Any:
        """As `PlainCoding.near`."""
        moved = self._still if flow is None else flow
        self._felt = self._ends[0].modify(self._late, moved, self._tick_s).effort
        return self._ends[0].message_j

    def far(self, arrived: list[Packet], newest: Up | None, flow: Array | None) -> Order:
        """As `PlainCoding.far`."""
        end = self._ends[1]
        end.receive(*(packet.load.extra for packet in arrived))
        order = super().far(arrived, newest, flow)
        wanted = self._still if flow is None else flow
        paid = self._affordable(wanted, max(end.budget_j, 0.0))
        return Order(None if paid is wanted else paid, order.seen_s)

    def _affordable(self, flow: Array, budget_j: float) -> Array:
        """The flow, or as much of it as its energy is paid for; the effort answers it at once where it can.

        Damping alone would add flow against an effort that the damper between command and machine reverses at once.
        """
        steady = port_energy(self._port.base, flow, self._tick_s)
        damped = self._port.feedthrough * port_energy(flow, flow, self._tick_s)
        if steady + damped <= budget_j:
            return flow
        # The positive root of damped s^2 + steady s = budget, without a difference of nearly equal numbers.
        root = math.sqrt(steady * steady + 4.0 * damped * budget_j)
        share = 2.0 * budget_j / (steady + root) if steady > 0.0 else (root - steady) / (2.0 * damped)
        return flow * min(share, 1.0)

    def settle(self, flow: Array, observation: Any, obeyed: bool) -> tuple[Any, Given | None]:
        """As `PlainCoding.settle`."""
        _, given = super().settle(flow, observation, obeyed)
        assert given is not None
        # Power is positive into the channel at both ends. The flow was scaled, not damped: no damping to credit.
        self._ends[1].account(-given.effort, given.flow, self._tick_s)
        return self._ends[1].message_j, given

    def shown(self, arrived: list[Packet], observation: Any) -> Any:
        """As `PlainCoding.shown`."""
        self._ends[0].receive(*(packet.load.extra for packet in arrived))
        self._late = self._port.of(observation)
        return self._port.replaced(observation, self._felt)
