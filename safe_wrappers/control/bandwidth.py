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
from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError


def phase_lag(crossover: float, control_dt: float, late_s: float = 0.0) -> float:
    """Phase in rad that hold and delays take from a loop at its crossover: `w (late + hold / 2)`.

    Delays do not change the gain, and the hold hardly does in the baseband, so the crossover stays where it is, and
    the phase margin of a continuous design becomes less by this much.

    Args:
        crossover: Crossover frequency w of the open loop, rad/s, > 0, below the Nyquist frequency pi / control_dt.
        control_dt: Sampling period in s; 0 for a loop that is not sampled.
        late_s: Fixed delays of computation, bus and plant together, s, >= 0.

    Raises:
        ConfigurationError: For a crossover at or above the Nyquist frequency.
    """
    half = 0.5 * control_dt
    if crossover * half >= 0.5 * math.pi:
        raise ConfigurationError(
            f"crossover must lie below the Nyquist frequency pi / control_dt; got {crossover} rad/s with "
            f"control_dt = {control_dt} s; the half-sample "
            "lag holds in the baseband only, so choose a slower loop or a shorter hold"
        )
    return crossover * (late_s + half)


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
