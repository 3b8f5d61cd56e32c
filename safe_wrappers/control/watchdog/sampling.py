"""Phase lag of a control loop by zero-order hold and delay.

In phase a zero-order hold equals a delay of half its interval, in the baseband: a sampled loop also sees aliases,
which that neglects. So the figures are accurate well below the sampling frequency, optimistic towards the Nyquist
frequency, and refused from there on. Example, an integrator under a proportional controller: at a crossover of a
tenth of the sampling frequency its margin is 0.3 degrees less than computed here; at 2 / hold it is unstable, with
33 degrees computed.

The phase margin is a nominal reserve. Whether a machine is stable depends on the sampled plant, its compensation, the
jitter and the measured total response.

Source: appendix "Discrete-time sampling and zero-order hold phase lag" with its footnote 2.
"""

import math

from safe_wrappers.errors import ConfigurationError


def hold_lag_s(control_dt: float) -> float:
    """Delay in s that equals a zero-order hold of `control_dt` seconds in phase: half of it."""
    return 0.5 * control_dt


def phase_lag(crossover: float, control_dt: float, late_s: float = 0.0) -> float:
    """Phase in rad that hold and delays take from a loop at its crossover: `w (late + hold / 2)`.

    Args:
        crossover: Crossover frequency w of the open loop, rad/s, > 0, below the Nyquist frequency pi / control_dt.
        control_dt: Sampling period in s; 0 for a loop that is not sampled.
        late_s: Fixed delays of computation, bus and plant together, s, >= 0.

    Raises:
        ConfigurationError: For a crossover at or above the Nyquist frequency.
    """
    half = hold_lag_s(control_dt)
    if crossover * half >= 0.5 * math.pi:
        raise ConfigurationError(
            f"crossover must lie below the Nyquist frequency pi / control_dt; got {crossover} rad/s with "
            f"control_dt = {control_dt} s; the half-sample "
            "lag holds in the baseband only, so choose a slower loop or a shorter hold"
        )
    return crossover * (late_s + half)


def margin_left(phase_margin: float, crossover: float, control_dt: float, late_s: float = 0.0) -> float:
    """Phase margin in rad that is left of a continuous design's; negative where more is lost than there was.

    Delays do not change the gain, and the hold hardly does in the baseband, so the crossover stays where it is. The
    other arguments and errors are those of `phase_lag`.
    """
    return phase_margin - phase_lag(crossover, control_dt, late_s)
