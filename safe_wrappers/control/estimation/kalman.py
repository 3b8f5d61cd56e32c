"""The sampled Kalman filter for many tracks at once.

It runs at every step and checks nothing; take `transition` and `noise` from `covariance.discretise`. The update has
Joseph's form: symmetric and positive semidefinite for any gain, rounding included.

Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), section 5.2.
"""

import numpy as np

from safe_wrappers.checks import Array


def predict(
    mean: Array, cov: Array, transition: Array, noise: Array, drift: Array | None = None
) -> tuple[Array, Array]:
    """Mean and covariance after one step without a measurement: `x -> F x + d`, `P -> F P F' + Q_d`.

    Args:
        mean: Estimate, shape (..., n).
        cov: Its covariance, shape (..., n, n).
        transition: F, shape (n, n), or one per track.
        noise: Q_d, shape (n, n), or one per track.
        drift: d, known displacement in this step, shape (n,) or (..., n); None for none.
    """
    moved = (transition @ mean[..., None])[..., 0]
    if drift is not None:
        moved += drift
    grown = transition @ cov @ np.swapaxes(transition, -1, -2)
    grown += noise
    return moved, 0.5 * (grown + np.swapaxes(grown, -1, -2))


def update(mean: Array, cov: Array, measured: Array, C: Array, R: Array) -> tuple[Array, Array]:
    """Mean and covariance after one measurement `y = C x + v` per track.

    Args:
        mean: Estimate, shape (..., n).
        cov: Its covariance, shape (..., n, n).
        measured: y, shape (..., m).
        C: Measurement matrix, shape (m, n), or one per track.
        R: Covariance of v (not its intensity), positive definite, shape (m, m), or one per track.
    """
    Ct = np.swapaxes(C, -1, -2)
    cross = cov @ Ct
    innovation_cov = C @ cross
    innovation_cov += R
    gain = cross @ np.linalg.inv(innovation_cov)
    innovation = measured - (C @ mean[..., None])[..., 0]
    left = gain @ C
    np.negative(left, out=left)
    np.einsum("...ii->...i", left)[...] += 1.0
    kept = left @ cov @ np.swapaxes(left, -1, -2)
    kept += gain @ R @ np.swapaxes(gain, -1, -2)
    mean = mean + (gain @ innovation[..., None])[..., 0]
    return mean, 0.5 * (kept + np.swapaxes(kept, -1, -2))
