"""The passivity observer and controller of one port.

Hannaford and Ryu (2002), "Time-domain passivity control of haptic interfaces": an observer sums the energy at a
port, and a controller adds just as much damping as brings the sum back to zero, at the tick at which it would turn
negative, and none otherwise. See `safe_wrappers.control.teleop.passivity_control` for causality, limits and debts.
"""

from numpy.typing import ArrayLike

from safe_wrappers.control.teleop.passivity_control import Causality, Damper, Interval, Passivated
from safe_wrappers.control.teleop.port_checks import RunningSum, energy_j, port_energy, port_vectors, positive


class PassivityObserver:
    """Sums the energy of a port. Several ports of one component are one whose efforts and flows are concatenated.

    Args:
        initial_storage_j: Energy that the component may give out beyond what it took in, at least 0 J.
    """

    def __init__(self, initial_storage_j: float = 0.0) -> None:
        self._energy = RunningSum(energy_j("initial_storage_j", initial_storage_j))

    def add(self, effort: ArrayLike, flow: ArrayLike, time_s: float) -> float:
        """Account one interval.

        Args:
            effort: N, shape (m,), or a number; held over the interval, or its mean.
            flow: m/s, of the same shape; the other way round.
            time_s: Length of the interval, > 0.

        Returns:
            `observed_j` after it.
        """
        f, v = port_vectors(effort=effort, flow=flow)
        self._energy.add(port_energy(f, v, positive("time_s", time_s)))
        return self._energy.value

    @property
    def observed_j(self) -> float:
        """Initial storage and all energy since, J: below 0 the component was active."""
        return self._energy.value


class PassivityController:
    """Keeps one port's observed energy from turning negative, with the smallest damping that does.

    Args:
        causality: Which of the two is changed, see above.
        initial_storage_j: See `PassivityObserver`.
        limit: Largest size of what is added, N (m/s in admittance causality), > 0; None: none.

    Raises:
        ConfigurationError: For an unknown causality, negative storage, or a limit that is not positive.
    """

    def __init__(
        self, causality: Causality = "impedance", initial_storage_j: float = 0.0, limit: float | None = None
    ) -> None:
        self._damper = Damper(causality, limit)
        self._settled = PassivityObserver(initial_storage_j)
        self._last: Interval | None = None

    @property
    def observed_j(self) -> float:
        """Energy at the end of the last interval, if it went as sampled, J."""
        if self._last is None:
            return self._settled.observed_j
        return self._settled.observed_j + self._last.energy_j + self._last.damped_j

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
            self._settled.add(last.answer + last.added, last.seen, last.time_s)
        owed = -(self._settled.observed_j + interval.energy_j)
        result, self._last = self._damper.dissipate(interval, owed)
        return result
