"""The consistency test of a Kalman filter: does its covariance describe its errors?

Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), section 5.4.
"""

import numpy as np

from safe_wrappers.checks import Array, whole_number
from safe_wrappers.errors import ConfigurationError


def normalised_error_squared(error: Array, cov: Array) -> Array:
    """`e' P^-1 e` (NEES): n on average where P is the covariance of e.

    Args:
        error: True minus estimated state, shape (..., n).
        cov: Covariance that the filter claims, positive definite, shape (..., n, n).

    Returns:
        Shape (...), dimensionless.
    """
    weighted = np.linalg.solve(cov, error[..., None])[..., 0]
    return np.asarray((error * weighted).sum(axis=-1))


def chi_square_band(n: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """The band in which the mean of `normalised_error_squared` over independent runs lies, if filter and truth agree.

    Args:
        n: Dimension of the state.
        runs: Number of independent runs that the mean is taken over.
        confidence: Probability of the band, as much left out below as above.

    Returns:
        Lower and upper end. Below: the filter doubts itself too much; above: it trusts itself too much.

    Raises:
        ConfigurationError: For n or runs below 1, or a confidence outside (0, 1).
    """
    for name, count in (("n", n), ("runs", runs)):
        whole_number(name, count, 1)
    if not 0.0 < confidence < 1.0:
        raise ConfigurationError(f"confidence must lie between 0 and 1, both excluded, got {confidence!r}")
    outside = 0.5 * (1.0 - confidence)
    from scipy.special import gammaincinv  # here: SciPy takes a while to import

    low, high = 2.0 * gammaincinv(0.5 * n * runs, [outside, 1.0 - outside]) / runs
    return float(low), float(high)
