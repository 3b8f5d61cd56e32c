"""Time-domain passivity control: damping as soon as a port has given out more energy than allowed.

Ryu, Artigas and Preusche (2010), "A passive bilateral control scheme for a teleoperator with time-varying
communication delay"; the damping is that of Hannaford and Ryu (2002), "Time-domain passivity control of haptic
interfaces".

In *impedance* causality a component answers a flow with an effort, so damping adds effort along the flow; in
*admittance* causality it answers an effort with a flow, and damping adds flow along the effort. What cannot be
dissipated (no flow, or a limit on the damping) is a debt, dissipated as soon as possible. Damping is computed for the
sampled flow and accounted for the actual one a tick later, so the energy may be slightly negative in between.
"""

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.teleop.port_checks import (
    RunningSum,
    energy_j,
    port_energy,
    port_vector,
    port_vectors,
    positive,
)
from safe_wrappers.errors import ConfigurationError

Causality = Literal["impedance", "admittance"]


class Passivated(NamedTuple):
    """A port after damping.

    Attributes:
        effort: N, shape (m,); in impedance causality the one to be applied.
        flow: m/s, shape (m,); in admittance causality the one to be applied.
        correction: Size of the added damping, N (m/s in admittance causality); 0: unchanged, bit for bit.
        debt_j: Energy that should have been dissipated and could not, J.
    """

    effort: Array
    flow: Array
    correction: float
    debt_j: float


class EnergyReference:
    """One end of a two-port channel that gives out no more energy than the other end reports as taken in.

    At every tick both ends `receive` what has arrived, `modify`, and send `message_j`. The sum of both ports'
    energies is then never below minus the initial storages (and debts), for any delay, reordering and loss. Power is
    positive into the channel at *both* ends.

    Args:
        causality: Which of the two this end changes, see above.
        initial_storage_j: Energy that this end may give out without any report, at least 0 J.
        limit: Largest size of what is added, N (m/s in admittance causality), > 0; None: none.
    """

    def __init__(
        self, causality: Causality = "impedance", initial_storage_j: float = 0.0, limit: float | None = None
    ) -> None:
        self._damper = Damper(causality, limit)
        self._initial = energy_j("initial_storage_j", initial_storage_j)
        self._taken_in, self._given_out, self._dissipated = RunningSum(), RunningSum(), RunningSum()
        self._heard = 0.0
        self._last: Interval | None = None

    @property
    def message_j(self) -> float:
        """Energy that this end has taken in from outside, J, without its own dissipation; to be sent. Never falls."""
        return self._taken_in.value

    @property
    def budget_j(self) -> float:
        """Energy that this end may still give out, J; below 0 it is in debt."""
        return self._initial + self._heard + self._dissipated.value - self._given_out.value

    def receive(self, *messages_j: float) -> None:
        """Take values of the other end's `message_j`, in any order, duplicates included."""
        for message in messages_j:
            self._heard = max(self._heard, energy_j("message_j", message))

    def modify(
        self, effort: ArrayLike, flow: ArrayLike, time_s: float, actual: ArrayLike | None = None
    ) -> Passivated:
        """The port's effort and flow for the coming interval.

        Args:
            effort: What the component would answer with (what it sees, in admittance causality), N, shape (m,).
            flow: What it sees (would answer with), m/s, of the same shape.
            time_s: Length of the interval over which they will be held, > 0.
            actual: What the seen quantity truly was on average since the last call (a displacement over its time,
                say), of the same shape; None: as sampled.
        """
        interval = self._damper.interval(effort, flow, time_s)
        if self._last is not None:
            last = self._last.settled(actual)
            through, damped = last.energy_j, last.damped_j  # both may raise
            self._dissipated.add(damped)
            self._book(through)
        owed = max(-interval.energy_j, 0.0) - self.budget_j
        result, self._last = self._damper.dissipate(interval, owed)
        return result

    def account(self, effort: ArrayLike, flow: ArrayLike, time_s: float) -> None:
        """Account an interval without damping, for callers that keep to `budget_j` by other means than `modify`.

        Effort (N) and flow (m/s) are numbers or of shape (m,); one is held over the interval of `time_s` > 0, the
        other its mean.
        """
        f, v = port_vectors(effort=effort, flow=flow)
        self._book(port_energy(f, v, positive("time_s", time_s)))

    def _book(self, through_j: float) -> None:
        (self._taken_in if through_j > 0.0 else self._given_out).add(abs(through_j))


class Interval(NamedTuple):
    """A port as sampled at the start of an interval, and the damping added to the component's answer."""

    answer: Array
    seen: Array
    added: Array
    time_s: float

    @property
    def energy_j(self) -> float:
        """Energy without damping, J."""
        return port_energy(self.answer, self.seen, self.time_s)

    @property
    def damped_j(self) -> float:
        """Energy of the damping alone, J."""
        return port_energy(self.added, self.seen, self.time_s)

    def settled(self, actual: ArrayLike | None) -> "Interval":
        """The interval with the actual value of the seen quantity."""
        if actual is None:
            return self
        given = port_vector("actual", actual)
        if given.size != self.seen.size:
            raise ConfigurationError(f"actual must have {self.seen.size} components, got {given.size}")
        return self._replace(seen=given)


class Damper:
    """The smallest damping that dissipates an energy, within a limit."""

    def __init__(self, causality: Causality, limit: float | None) -> None:
        if causality not in get_args(Causality):
            raise ConfigurationError(f"causality must be one of impedance, admittance, got {causality!r}")
        self._answers_effort = causality == "impedance"
        self._limit = math.inf if limit is None else positive("limit", limit)

    def interval(self, effort: ArrayLike, flow: ArrayLike, time_s: float) -> Interval:
        """The port as sampled, without damping."""
        f, v = port_vectors(effort=effort, flow=flow)
        answer, seen = (f, v) if self._answers_effort else (v, f)
        time = positive("time_s", time_s)
        port_energy(f, v, time)  # raises before anything is changed
        return Interval(answer.copy(), seen.copy(), np.zeros_like(answer), time)

    def dissipate(self, interval: Interval, owed_j: float) -> tuple[Passivated, Interval]:
        """Damp so that `owed_j` is dissipated, or as much as the limit allows."""
        speed = math.hypot(*interval.seen)
        travel = speed * interval.time_s
        size = min(owed_j / travel, self._limit) if owed_j > 0.0 and travel > 0.0 else 0.0
        if 0.0 < size < math.inf:
            interval = interval._replace(added=size * (interval.seen / speed))
        else:
            size = 0.0
        changed = interval.answer + interval.added if size else interval.answer
        effort, flow = (changed, interval.seen) if self._answers_effort else (interval.seen, changed)
        debt = max(0.0, owed_j - size * travel)
        return Passivated(effort.copy(), flow.copy(), size, debt), interval
