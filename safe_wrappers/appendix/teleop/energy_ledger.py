"""The energy of one component: what went in, what is stored, what was lost as heat, and whether it made any.

Source: appendix "Passivity and Energy-Bounded Interaction", equation 2; conventions as in
`safe_wrappers.control.teleop.passivity`, which has the ledger of a channel.
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.control.teleop.port_checks import RunningSum, energy_j, port_energy, port_vectors, positive

_EPS = float(np.finfo(np.float64).eps)


class EnergyLedger:
    """Accounts the two sides of equation 2 for one component, over any number of steps.

    Several ports of one component are one port whose efforts and flows are concatenated.

    Args:
        initial_storage_j: V(0), or a bound on it, at least 0 J.
    """

    def __init__(self, initial_storage_j: float = 0.0) -> None:
        self.initial_storage_j = energy_j("initial_storage_j", initial_storage_j)
        """V(0), J."""
        self._absorbed = RunningSum()
        self._dissipated = RunningSum()
        self._rounding = 0.0
        self._lowest = 0.0
        self._created = 0.0

    def add(
        self,
        effort: ArrayLike,
        flow: ArrayLike,
        time_s: float,
        stored_j: float | None = None,
        dissipated_j: float = 0.0,
    ) -> None:
        """Account one interval.

        Args:
            effort: F, N, shape (m,), or a number; held over the interval, or its mean.
            flow: v, m/s, of the same shape; the mean where the effort is held, and held where it is the mean.
            time_s: Length of the interval, > 0.
            stored_j: V at its end, if known, at least 0; None counts as 0, the least possible.
            dissipated_j: Energy lost as heat within the interval, if known, at least 0.
        """
        time = positive("time_s", time_s)
        f, v = port_vectors(effort=effort, flow=flow)
        stored = 0.0 if stored_j is None else energy_j("stored_j", stored_j)
        dissipated = energy_j("dissipated_j", dissipated_j)
        self._absorbed.add(port_energy(f, v, time))
        self._dissipated.add(dissipated)
        # Storage is computed from a state that is rounded at every step, so its rounding counts each time.
        exchanged = float(np.abs(f) @ np.abs(v)) * time + dissipated
        self._rounding += (f.size + 4) * _EPS * (exchanged + stored)
        self._lowest = min(self._lowest, self._absorbed.value)
        missing = stored + self._dissipated.value - self._absorbed.value - self.initial_storage_j
        self._created = max(self._created, missing)

    @property
    def absorbed_j(self) -> float:
        """Integral of F.v dt, J: positive into the component."""
        return self._absorbed.value

    @property
    def dissipated_j(self) -> float:
        """Known dissipation, J."""
        return self._dissipated.value

    @property
    def extracted_j(self) -> float:
        """Largest net energy extracted at any time so far, J, at least 0."""
        return -self._lowest

    @property
    def extractable_j(self) -> float:
        """Largest energy that may still come out, `V(0) + absorbed - dissipated`, J; below 0: not passive."""
        return self.initial_storage_j + self.absorbed_j - self.dissipated_j

    @property
    def created_j(self) -> float:
        """Largest violation of equation 2 so far, J, with the storage and dissipation that `add` was given."""
        return self._created

    @property
    def rounding_j(self) -> float:
        """Bound on the rounding of these sums and of the storage that `add` was given, J."""
        return self._rounding + 4.0 * _EPS * self.initial_storage_j

    @property
    def passive(self) -> bool:
        """Whether equation 2 has held at all times so far, to rounding."""
        return self._created <= self.rounding_j
