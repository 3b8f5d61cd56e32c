"""What bounds the bandwidth of a control loop: the lag of hold and delays, and the resonances of springs.

In phase a zero-order hold equals a delay of half its interval, in the baseband: a sampled loop also sees aliases,
which that neglects. So the figures are accurate well below the sampling frequency, optimistic towards the Nyquist
frequency, and refused from there on. Example, an integrator under a proportional controller: at a crossover of a
tenth of the sampling frequency its margin is 0.3 degrees less than computed here; at 2 / hold it is unstable, with
33 degrees computed. Whether a machine is stable depends on the sampled plant, its compensation, the jitter and the
measured total response.

Source: appendix "Discrete-time sampling and zero-order hold phase lag" with its footnote 2, and "Flexible joint
dynamics and singular perturbations".
"""

import math
import warnings
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    PhaseMarginWarning,
    check_fields,
    non_negative,
    positive,
)

WARN_BELOW_DEG: Final = 30.0
"""Of phase margin, at which a plant warns when it is bound."""


@dataclass(frozen=True)
class ControlLoop:
    """The loop that a controller closes through a plant, as it was designed: in continuous time and without delay.

    The plant adds what it knows: its `control_dt` is the hold, and its `delay_s` (evidence, detection and actuation)
    counts beside the two delays that are declared here.

    Args:
        crossover: Frequency at which the gain of the open loop is 1, rad/s.
        phase_margin_deg: Of the design, degrees, below 180.
        compute_s: Fixed delay of the computation, s.
        bus_s: Fixed delay of the bus, s.

    Raises:
        ConfigurationError: A number outside its range, or a design that has no more margin than is asked for.

    Example:
        >>> loop = ControlLoop(crossover=4.0, phase_margin_deg=60.0, compute_s=0.005)
        >>> round(loop.margin_left_deg(control_dt=0.05, delay_s=0.1), 1)
        30.2

    Source: appendix "Discrete-time sampling and zero-order hold phase lag".
    """

    crossover: float
    phase_margin_deg: float
    compute_s: float = 0.0
    bus_s: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, positive, ["crossover"], "rad/s")
        check_fields(self, positive, ["phase_margin_deg"], "degrees")
        check_fields(self, non_negative, ["compute_s", "bus_s"], "s")
        if not WARN_BELOW_DEG < self.phase_margin_deg < 180.0:
            raise ConfigurationError(
                f"phase_margin_deg is above {WARN_BELOW_DEG:g} degrees, and below 180: hold "
                f"and delays only take away; got {self.phase_margin_deg:g}"
            )

    def margin_left_deg(self, control_dt: float, delay_s: float = 0.0) -> float:
        """What hold and delays of a plant, s, leave of the phase margin, degrees; at 0 or below nothing is left.

        They take `w (delays + hold / 2)` in phase at the crossover w, rad. Delays do not change the gain, and the
        hold hardly does in the baseband, so the crossover stays where it is.

        Raises:
            ConfigurationError: A crossover at or above the Nyquist frequency, where a hold is no delay any more.
        """
        if self.crossover * control_dt >= math.pi:
            raise ConfigurationError(
                f"crossover must lie below the Nyquist frequency pi / control_dt; got {self.crossover} rad/s with "
                f"control_dt = {control_dt} s: choose a slower loop or a shorter hold"
            )
        late_s = self.compute_s + delay_s + self.bus_s + 0.5 * control_dt
        return self.phase_margin_deg - math.degrees(self.crossover * late_s)

    def warn_if_short(self, control_dt: float, delay_s: float) -> None:
        """Warn if less is left than `WARN_BELOW_DEG`; raises as `margin_left_deg`."""
        left = self.margin_left_deg(control_dt, delay_s)
        if left < WARN_BELOW_DEG:
            most = (self.phase_margin_deg - WARN_BELOW_DEG) / (self.phase_margin_deg - left)
            warnings.warn(
                f"hold and delays leave {left:.1f} degrees of a phase margin of {self.phase_margin_deg:g}, less than "
                f"{WARN_BELOW_DEG:g}: design a loop of {self.crossover:g} rad/s for at most "
                f"{most * self.crossover:.3g} rad/s, or shorten hold and delays",
                PhaseMarginWarning,
                stacklevel=3,
            )


class Modes(NamedTuple):
    """Vibrations of a machine, the slowest first; rigid motions have a resonance of 0."""

    resonances: Array  # shape (n,), rad/s
    damping_ratios: Array  # shape (n,), to first order in the damping; 0 for rigid motions
    shapes: Array  # columns v with v . M v = 1, shape (n, n)


def modes(inertia: Array, stiffness: Array, damping: Array) -> Modes:
    """Vibrations of M x'' + D x' + K x = 0.

    Args:
        inertia: M, symmetric and positive definite, shape (n, n).
        stiffness: K, symmetric and positive semidefinite, shape (n, n).
        damping: D, shape (n, n).
    """
    from scipy.linalg import eigh  # here: SciPy takes a while to import

    squares, shapes = eigh(stiffness, inertia)
    rigid = squares <= 1e-9 * squares.max(initial=0.0)
    omega = np.sqrt(np.where(rigid, 0.0, squares))
    own = np.einsum("ji,jk,ki->i", shapes, damping, shapes)
    ratios = np.divide(own, 2.0 * omega, out=np.zeros_like(own), where=~rigid)
    return Modes(omega, ratios, shapes)
