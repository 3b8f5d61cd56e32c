"""Phase lag of a control loop by zero-order hold and delay.

In phase a zero-order hold equals a delay of half its interval, in the baseband: a sampled loop also sees aliases,
which that neglects. So the figures are accurate well below the sampling frequency, optimistic towards the Nyquist
frequency, and refused from there on. Example, an integrator under a proportional controller: at a crossover of a
tenth of the sampling frequency its margin is 0.3 degrees less than computed here; at 2 / hold it is unstable, with
33 degrees computed.

The phase margin is a nominal reserve. Whether a machine is stable depends on the sampled plant, its compensation, the
jitter and the measured total response.

Source: appendix "Discrete-time sampling and zero-order hold phase lag" with its footnote 2. Arguments broadcast.
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError


def _quantity(name: str, given: ArrayLike, unit: str, *, zero: bool) -> Array:
    try:
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} is a number in {unit}, got {given!r}") from None
    if not (np.isfinite(array).all() and ((array >= 0.0) if zero else (array > 0.0)).all()):
        raise ConfigurationError(
            f"{name} must be {'>= 0' if zero else '> 0'} and finite ({unit}), got {array}"
        )
    return array


def hold_lag_s(control_dt: ArrayLike) -> Array:
    """Delay in s that equals a zero-order hold of `control_dt` seconds in phase: half of it.

    Raises:
        ConfigurationError: For a hold that is negative or not finite.
    """
    return np.asarray(0.5 * _quantity("control_dt", control_dt, "s", zero=True))


def phase_lag(
    crossover: ArrayLike, control_dt: ArrayLike, compute_s: ArrayLike = 0.0, bus_s: ArrayLike = 0.0
) -> Array:
    """Phase in rad that hold, computation and bus take from a loop at its crossover: `w (compute + bus + hold / 2)`.

    Args:
        crossover: Crossover frequency w of the open loop, rad/s, > 0, below the Nyquist frequency pi / control_dt.
        control_dt: Sampling period in s, >= 0; 0 for a loop that is not sampled.
        compute_s: Fixed delay of the computation in s, >= 0.
        bus_s: Fixed delay of the bus in s, >= 0.

    Raises:
        ConfigurationError: For times that are negative, a crossover that is not positive, or one at or above the
            Nyquist frequency.
    """
    w = _quantity("crossover", crossover, "rad/s", zero=False)
    half = hold_lag_s(control_dt)
    if (w * half >= 0.5 * np.pi).any():
        raise ConfigurationError(
            f"crossover must lie below the Nyquist frequency pi / control_dt; got {w} rad/s with "
            f"control_dt = {2.0 * half} s; the half-sample "
            "lag holds in the baseband only, so choose a slower loop or a shorter hold"
        )
    late = _quantity("compute_s", compute_s, "s", zero=True) + _quantity("bus_s", bus_s, "s", zero=True)
    return np.asarray(w * (late + half))


def margin_left(
    phase_margin: ArrayLike,
    crossover: ArrayLike,
    control_dt: ArrayLike,
    compute_s: ArrayLike = 0.0,
    bus_s: ArrayLike = 0.0,
) -> Array:
    """Phase margin in rad that is left of a continuous design's; negative where more is lost than there was.

    Delays do not change the gain, and the hold hardly does in the baseband, so the crossover stays where it is.

    Args:
        phase_margin: Margin of the loop without hold and delays, rad.
        crossover: As for `phase_lag`.
        control_dt: As for `phase_lag`.
        compute_s: As for `phase_lag`.
        bus_s: As for `phase_lag`.

    Raises:
        ConfigurationError: As `phase_lag`, or for a margin that is not finite.
    """
    margin = np.asarray(phase_margin, dtype=np.float64)
    if not np.isfinite(margin).all():
        raise ConfigurationError(f"phase_margin must be finite (rad), got {margin}")
    return np.asarray(margin - phase_lag(crossover, control_dt, compute_s, bus_s))
