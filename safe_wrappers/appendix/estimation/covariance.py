"""Covariance while a sensor measures and while it does not, in continuous time.

The system is linear, x' = A x + b + w, y = C x + v, with white noise of the *intensities* Q and R: Q in units of
x^2 / s, R in units of y^2 s. With measurements the error covariance of the Kalman-Bucy filter follows the Riccati
equation; without, the Lyapunov equation:

    P' = A P + P A' + Q - P C' R^-1 C P          P' = A P + P A' + Q

Both are solved exactly, by matrix exponentials over short times and doubling.

Source: appendix "Continuous covariance propagation and observability"; Anderson and Moore, "Optimal Filtering"
(1979), section 6.7, for doubling the Riccati equation.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.control.estimation.covariance import (
    checked_covariance,
    checked_noise,
    checked_square,
    checked_system,
    checked_times,
    discretise,
    refuse_overflow,
)
from safe_wrappers.control.numerics.block_exponentials import doublings_for, norm_or_one, short_exponential
from safe_wrappers.errors import ConfigurationError

_MODE = 1e-8
"""Relative to the norm of A: a mode this close to the imaginary axis, or to being unseen, counts as it. Eigenvalues
of a double pole are not known any better than that."""


def lyapunov_rate(P: Array, A: Array, Q: Array) -> Array:
    """`A P + P A' + Q`: growth without measurements.

    Args:
        P: Covariance, shape (..., n, n).
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, shape (n, n).

    Returns:
        dP/dt, shape (..., n, n).
    """
    flow = A @ P
    return np.asarray(flow + np.swapaxes(flow, -1, -2) + Q)


def riccati_rate(P: Array, A: Array, Q: Array, C: Array, R: Array) -> Array:
    """`A P + P A' + Q - P C' R^-1 C P`: the growth while C x is measured.

    Args:
        P: Covariance, shape (..., n, n).
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, shape (n, n).
        C: Measurement matrix, shape (m, n).
        R: Intensity of the measurement noise, shape (m, m).

    Returns:
        dP/dt, shape (..., n, n).
    """
    return np.asarray(lyapunov_rate(P, A, Q) - P @ C.T @ np.linalg.solve(R, C) @ P)


def kalman_bucy_gain(P: Array, C: Array, R: Array) -> Array:
    """`P C' R^-1`: gain of the filter in continuous time.

    Args:
        P: Covariance, shape (..., n, n).
        C: Measurement matrix, shape (m, n).
        R: Intensity of the measurement noise, shape (m, m).

    Returns:
        Shape (..., n, m), 1/s times the units of x per y.
    """
    return np.asarray(P @ np.linalg.solve(R, C).T)


def blind_covariance(P0: ArrayLike, A: ArrayLike, Q: ArrayLike, time_s: ArrayLike) -> Array:
    """The covariance after a time without measurements: the Lyapunov equation, exactly.

    Args:
        P0: Covariance when the sensor was lost, shape (..., n, n).
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, shape (n, n).
        time_s: s since then, at least 0, shape (k...).

    Returns:
        Shape (k..., ..., n, n).

    Raises:
        ConfigurationError: Bad matrices, a negative time, or a growth that leaves the range of floats.
    """
    step = discretise(A, Q, time_s)
    times = checked_times(time_s)
    start = checked_covariance("P0", P0, step.noise.shape[-1])
    between = (*times.shape, *(1,) * (start.ndim - 2), *step.noise.shape[-2:])
    transition, noise = step.transition.reshape(between), step.noise.reshape(between)
    with np.errstate(over="ignore", invalid="ignore"):
        grown = transition @ start @ np.swapaxes(transition, -1, -2) + noise
    refuse_overflow(times, grown)
    return np.asarray(0.5 * (grown + np.swapaxes(grown, -1, -2)))


def seen_covariance(
    P0: ArrayLike, A: ArrayLike, Q: ArrayLike, C: ArrayLike, R: ArrayLike, time_s: ArrayLike
) -> Array:
    """The covariance after a time of measuring C x all along: the Riccati equation, exactly.

    Args:
        P0: Covariance at its start, shape (..., n, n).
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, shape (n, n).
        C: Measurement matrix, shape (m, n).
        R: Intensity of the measurement noise, positive definite, shape (m, m).
        time_s: s since then, at least 0, shape (k...).

    Returns:
        Shape (k..., ..., n, n).

    Raises:
        ConfigurationError: Bad matrices, a negative time, or (with an unstable mode that is not seen) a growth that
            leaves the range of floats.
    """
    a, q = checked_system(A, Q)
    _, _, information = _sensor(a, C, R)
    times = checked_times(time_s)
    start = checked_covariance("P0", P0, len(a))
    seen = np.empty((*times.shape, *start.shape))
    for index in np.ndindex(times.shape):
        with np.errstate(over="ignore", invalid="ignore"):
            seen[index] = riccati_flow(start, a, q, information, float(times[index]))
        refuse_overflow(times[index], seen[index])
    return seen


def double_integrator_covariance(P0: ArrayLike, intensity: float, time_s: ArrayLike) -> Array:
    """The closed form for position and velocity under white acceleration noise, without measurements.

    `sigma_p^2 = P11 + 2 P12 t + P22 t^2 + q t^3 / 3`, `P12 + P22 t + q t^2 / 2`, `P22 + q t`: the uncertain velocity
    enters with t^2, the noise with t^3.

    Args:
        P0: Covariance of position and velocity at the start, shape (2, 2).
        intensity: q_c, of the acceleration noise, m^2/s^3, at least 0.
        time_s: s, at least 0, shape (...).

    Returns:
        Shape (..., 2, 2).

    Raises:
        ConfigurationError: A bad P0 or intensity, or a negative time.
    """
    start = checked_covariance("P0", P0, 2)
    if start.ndim != 2:
        raise ConfigurationError(f"P0 must have shape (2, 2), got {start.shape}")
    if not (math.isfinite(intensity) and intensity >= 0.0):
        raise ConfigurationError(f"intensity must be a finite number of at least 0, got {intensity!r}")
    t = checked_times(time_s)
    grown = np.empty((*t.shape, 2, 2))
    velocity = start[1, 1]
    grown[..., 0, 0] = start[0, 0] + t * (2.0 * start[0, 1] + t * (velocity + t * intensity / 3.0))
    grown[..., 0, 1] = grown[..., 1, 0] = start[0, 1] + t * (velocity + t * intensity / 2.0)
    grown[..., 1, 1] = velocity + t * intensity
    return grown


def steady_state(A: ArrayLike, Q: ArrayLike, C: ArrayLike, R: ArrayLike) -> Array:
    """The limit of the covariance under continuous measurement, from any start: the algebraic Riccati equation.

    Args:
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, shape (n, n).
        C: Measurement matrix, shape (m, n).
        R: Intensity of the measurement noise, positive definite, shape (m, m).

    Returns:
        Shape (n, n).

    Raises:
        ConfigurationError: Bad matrices, or there is no such covariance: a mode that does not decay is not seen (not
            detectable: its covariance grows without end), or no noise reaches it (not stabilisable: where it leads
            depends on the start, or it gets there slower than exponentially). It names the mode.
    """
    a, q = checked_system(A, Q)
    c, r, information = _sensor(a, C, R)
    scale = norm_or_one(a)
    _refuse_unreached(a, c, scale, "detectable", "C does not see it, so its covariance grows without end")
    _refuse_unreached(
        a.T,
        q,
        scale,
        "stabilisable",
        "no noise of Q reaches it, so the filter stops listening to measurements",
    )
    try:
        from scipy.linalg import solve_continuous_are  # here: SciPy takes a while to import

        steady = solve_continuous_are(a.T, c.T, q, r)
    except np.linalg.LinAlgError as error:
        raise ConfigurationError(f"no steady state was found for these A, Q, C and R: {error}") from None
    closed = np.linalg.eigvals(a - steady @ information)
    if not closed.real.max() < 0.0:
        raise ConfigurationError(
            f"no steady state was found: the filter's own errors would not decay (mode {closed.real.max():.6g} 1/s)"
        )
    return np.asarray(0.5 * (steady + steady.T))


def _refuse_unreached(a: Array, c: Array, scale: float, word: str, why: str) -> None:
    """Popov, Belevitch and Hautus: a mode is unreached where [A - mode; C] has a null direction."""
    for mode in np.linalg.eigvals(a):
        if mode.real < -_MODE * scale:
            continue
        pencil = np.vstack(((a - mode * np.eye(len(a))) / scale, c / norm_or_one(c)))
        _, singular, directions = np.linalg.svd(pencil)
        if singular[-1] < _MODE:
            direction = np.round(directions[-1].conj() / np.abs(directions[-1]).max(), 6)
            shown = direction.real if np.isreal(direction).all() else direction
            named = mode.real if mode.imag == 0.0 else mode
            raise ConfigurationError(
                f"there is no steady state: the system is not {word}. The mode {named:.6g} 1/s, direction {shown}, "
                f"does not decay, and {why}"
            )


def _sensor(a: Array, C: ArrayLike, R: ArrayLike) -> tuple[Array, Array, Array]:
    """C, R and the rate of information C' R^-1 C."""
    c = finite_array("C", C)
    if c.ndim != 2 or c.shape[1] != len(a) or len(c) == 0:
        raise ConfigurationError(f"C must have shape (m, {len(a)}), a row per measurement, got {c.shape}")
    r = checked_noise("R", checked_square("R", R), len(c))
    return c, r, np.asarray(c.T @ np.linalg.solve(r, c))


def riccati_flow(start: Array, a: Array, q: Array, information: Array, time: float) -> Array:
    """P(t) of the Riccati equation: P -> Q_t + E P (I + G P)^-1 E', with E, Q_t, G by doubling.

    Over a short time they are the blocks of the Hamiltonian's exponential. Two equal steps in a row are one of the
    same form, in which only sums and products of positive semidefinite matrices occur.
    """
    unit = math.sqrt(norm_or_one(q) / norm_or_one(information))
    hamiltonian = np.block([[a, q / unit], [information * unit, -a.T]])
    doublings = int(doublings_for(norm_or_one(hamiltonian), np.asarray(time)))
    exponential = short_exponential(hamiltonian * (time / 2.0**doublings))
    n = len(a)
    transition = np.linalg.inv(exponential[n:, n:]).T
    noise, seen = exponential[:n, n:] @ transition.T, transition.T @ exponential[n:, :n]
    # An unstable mode that no noise reaches grows in all three and cancels only in P: beyond this, steps are taken.
    while doublings > 0 and np.abs(np.linalg.eigvals(transition)).max() < 1e4:
        doublings -= 1
        between = np.linalg.inv(np.eye(n) + noise @ seen)
        noise, seen, transition = (
            noise + transition @ between @ noise @ transition.T,
            seen + transition.T @ seen @ between @ transition,
            transition @ between @ transition,
        )
        noise, seen = 0.5 * (noise + noise.T), 0.5 * (seen + seen.T)
    now = start / unit
    for _ in range(2**doublings):
        values, vectors = np.linalg.eigh(now)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
        turned = np.swapaxes(root, -1, -2)
        moved = transition @ root @ np.linalg.solve(np.eye(n) + turned @ seen @ root, turned) @ transition.T
        later = noise + moved
        later = 0.5 * (later + np.swapaxes(later, -1, -2))
        if np.array_equal(later, now) or not np.isfinite(later).all():
            return np.asarray(later * unit)  # at rest, bit for bit, for good; or out of range
        now = later
    return np.asarray(now * unit)
