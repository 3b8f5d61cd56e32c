"""How often an error leaves k standard deviations, each answer with the assumption that it rests on.

A covariance alone is not a hard error envelope: how much probability lies outside k sigma depends on the tail, and
all of it on the covariance being right (the growth model, its noise intensities, no outlier). None of the functions
here can check that. From the weakest assumption to the strongest:

- "distribution-free": the covariance is right, nothing else (`chebyshev_tail`);
- "unimodal": and the error, one number, has a single-peaked density (`unimodal_tail`);
- "gaussian": and the error is normal (`gaussian_tail`).

For `dimensions` d > 1, "k sigma" is the ellipsoid `e' P^-1 e <= k^2`. A ball whose radius is k times the largest
standard deviation over all directions holds this ellipsoid, so its tail is no larger.

Source: appendix "Continuous lyapunov and riccati covariance dynamics" for the caveat; Chen (2007) for Chebyshev's
inequality in d dimensions; Pukelsheim, "The Three Sigma Rule" (1994), for the unimodal one.
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, whole_number
from safe_wrappers.errors import ConfigurationError, UnknownNameError

ASSUMPTIONS = ("gaussian", "unimodal", "distribution-free")


def gaussian_tail(sigmas: ArrayLike, dimensions: int = 1) -> Array:
    """Probability that a *normal* error of this covariance lies `sigmas` or more away (chi-square survival).

    Args:
        sigmas: k >= 0, shape (...).
        dimensions: d, of the error.

    Returns:
        Probability, shape (...): exact if the error is normal and the covariance right, no bound if it is not.

    Raises:
        ConfigurationError: For negative or non-finite sigmas, or fewer than one dimension.
    """
    k, d = _checked(sigmas, dimensions)
    from scipy.special import gammaincc  # here: SciPy takes a while to import

    return np.asarray(gammaincc(0.5 * d, 0.5 * k * k), dtype=np.float64)


def unimodal_tail(sigmas: ArrayLike) -> Array:
    """Largest probability with which a *single-peaked* error in one dimension lies `sigmas` or more away.

    Vysochanskij and Petunin: `4 / (9 k^2)` from k = sqrt(8/3) on, where it is 1/6; below that the same theorem gives
    `4 / (3 k^2) - 1/3`, which is 1 at k = 1.

    Args:
        sigmas: k >= 0, shape (...).

    Returns:
        Bound on the probability, shape (...), at most 1.

    Raises:
        ConfigurationError: For negative or non-finite sigmas.
    """
    k, _ = _checked(sigmas, 1)
    square = np.maximum(k * k, 1.0)
    return np.where(square >= 8.0 / 3.0, 4.0 / (9.0 * square), 4.0 / (3.0 * square) - 1.0 / 3.0)


def chebyshev_tail(sigmas: ArrayLike, dimensions: int = 1) -> Array:
    """Largest probability with which *any* error of this covariance lies `sigmas` or more away: `min(1, d / k^2)`.

    Args:
        sigmas: k >= 0, shape (...).
        dimensions: d, of the error.

    Returns:
        Bound on the probability, shape (...). No distribution of this covariance exceeds it, and one reaches it.

    Raises:
        ConfigurationError: For negative or non-finite sigmas, or fewer than one dimension.
    """
    k, d = _checked(sigmas, dimensions)
    return np.asarray(d / np.maximum(k * k, d), dtype=np.float64)


def sigmas_for(probability: ArrayLike, dimensions: int = 1, assume: str = "gaussian") -> Array:
    """The k for which an error leaves k sigma with at most this probability, under a named assumption.

    Args:
        probability: In (0, 1), shape (...).
        dimensions: d, of the error.
        assume: "gaussian", "unimodal" (one dimension only) or "distribution-free".

    Returns:
        k, shape (...): the inverse of the assumption's tail.

    Raises:
        UnknownNameError: For another assumption; it lists these.
        ConfigurationError: For a probability outside (0, 1), fewer than one dimension, or "unimodal" in several.
    """
    p = finite_array("probability", probability)
    if not ((p > 0.0) & (p < 1.0)).all():
        raise ConfigurationError(f"probability must lie between 0 and 1, both excluded, got {probability!r}")
    d = whole_number("dimensions", dimensions, 1)
    if assume == "gaussian":
        from scipy.special import gammainccinv  # here: SciPy takes a while to import

        return np.asarray(np.sqrt(2.0 * gammainccinv(0.5 * d, p)), dtype=np.float64)
    if assume == "distribution-free":
        return np.asarray(np.sqrt(d / p), dtype=np.float64)
    if assume == "unimodal":
        if d != 1:
            raise ConfigurationError(
                f"the unimodal tail is for an error in one dimension, got dimensions={d}"
            )
        return np.where(p <= 1.0 / 6.0, 2.0 / (3.0 * np.sqrt(p)), 2.0 / np.sqrt(3.0 * p + 1.0))
    raise UnknownNameError(f"assume must be one of {', '.join(map(repr, ASSUMPTIONS))}, got {assume!r}")


def _checked(sigmas: ArrayLike, dimensions: int) -> tuple[Array, int]:
    k = finite_array("sigmas", sigmas)
    if (k < 0.0).any():
        raise ConfigurationError(f"sigmas must be at least 0, got {sigmas!r}")
    return k, whole_number("dimensions", dimensions, 1)
