"""How the covariance of an estimate shrinks while the sensor sees, and grows while it does not.

The system is linear, x' = A x + b + w, y = C x + v, with white noise of the *intensities* Q and R (covariance kernels
Q delta(t - s) and R delta(t - s)): Q in units of x^2 / s, R in units of y^2 s. While it is seen, the error covariance
of the Kalman-Bucy filter follows the Riccati equation; while it is not, the Lyapunov equation:

    P' = A P + P A' + Q - P C' R^-1 C P          P' = A P + P A' + Q

Nothing here integrates step by step: matrix exponentials over short times are exact, and longer times are put
together by doubling, which stays positive semidefinite and does not overflow where the covariance itself does not.

Growth may be bounded, linear, polynomial or exponential, and it need not be monotonic. Covariance alone is not a hard
error envelope unless its tail and model assumptions are justified: see `safe_wrappers.appendix.sigma_coverage`.

Source: appendix "Continuous covariance propagation and observability"; Van Loan (1978) for the discretisation;
Anderson and Moore, "Optimal Filtering" (1979), for doubling the Riccati equation.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.estimation.first_crossing import first_crossing
from safe_wrappers.control.numerics.block_exponentials import (
    Discrete,
    integral,
    norm_or_one,
    riccati_flow,
    van_loan,
)
from safe_wrappers.control.numerics.finite import finite_arrays
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]

_SYMMETRY = 1e-9
"""Asymmetry, and negative eigenvalues, that pass for rounding: relative to the largest entry or eigenvalue."""
_MODE = 1e-8
"""Relative to the norm of A: a mode this close to the imaginary axis, or to being unseen, counts as it. Eigenvalues
of a double pole are not known any better than that."""
_GOAL = 1e-12
"""A tolerance is met with this much to spare, relative, so that rounding never makes a time late."""
_LARGEST = 1e60
"""A tolerance above it counts as it: the covariance must not overflow before it gets there."""


def checked_covariance(name: str, matrix: ArrayLike, n: int | None = None) -> Array:
    """A covariance or a noise intensity as float64: symmetric and positive semidefinite.

    Args:
        name: What the error calls it.
        matrix: Shape (..., n, n).
        n: Its size, if that is given.

    Returns:
        The matrix, its rounding-sized asymmetry removed, shape (..., n, n).

    Raises:
        ConfigurationError: Not a finite square matrix of this size, not symmetric, or with a negative eigenvalue; it
            names the matrix and says by how much.
    """
    symmetric, smallest, largest = _symmetric(name, matrix, n)
    if smallest < -_SYMMETRY * largest:
        raise ConfigurationError(
            f"{name} must be positive semidefinite, its smallest eigenvalue is {smallest:.6g}"
        )
    return symmetric


def checked_noise(name: str, matrix: ArrayLike, n: int | None = None) -> Array:
    """As `checked_covariance`, but positive definite: no measurement is exact.

    Raises:
        ConfigurationError: As there, and for a singular matrix.
    """
    symmetric, smallest, largest = _symmetric(name, matrix, n)
    if not smallest > 1e-14 * largest:
        raise ConfigurationError(
            f"{name} must be positive definite (no measurement without noise), its smallest eigenvalue is "
            f"{smallest:.6g} and its largest {largest:.6g}"
        )
    return symmetric


def lyapunov_rate(P: Array, A: Array, Q: Array) -> Array:
    """`A P + P A' + Q`: the growth while nothing is seen.

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
    """`P C' R^-1`: how the filter in continuous time weighs the innovation.

    Args:
        P: Covariance, shape (..., n, n).
        C: Measurement matrix, shape (m, n).
        R: Intensity of the measurement noise, shape (m, m).

    Returns:
        Shape (..., n, m), 1/s times the units of x per y.
    """
    return np.asarray(P @ np.linalg.solve(R, C).T)


def discretise(A: ArrayLike, Q: ArrayLike, time_s: ArrayLike) -> Discrete:
    """The exact step over a time, by Van Loan's block exponential and doubling.

    Args:
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, positive semidefinite, shape (n, n).
        time_s: s, at least 0, shape (...).

    Returns:
        Transition and noise, shape (..., n, n) each; identity and zero for time 0.

    Raises:
        ConfigurationError: Bad matrices, a negative time, or a growth that leaves the range of floats.
    """
    a, q = _system(A, Q)
    times = _times(time_s)
    step = van_loan(a, q, times)
    _in_range(*step, times)
    return step


def discretise_drift(A: ArrayLike, b: ArrayLike, time_s: ArrayLike) -> Array:
    """Where a constant drift carries the state: the integral of `exp(A s) b` over a time, exact for singular A too.

    Args:
        A: System matrix, 1/s, shape (n, n).
        b: Drift of x' = A x + b, shape (..., n).
        time_s: s, at least 0, shape (k...).

    Returns:
        Displacement to add to `exp(A t) x`, shape (k..., ..., n).

    Raises:
        ConfigurationError: Bad matrices, a negative time, or a growth that leaves the range of floats.
    """
    a = _square("A", A)
    times = _times(time_s)
    (drift,) = finite_arrays(b=b)
    if drift.ndim == 0 or drift.shape[-1] != len(a):
        raise ConfigurationError(
            f"b must have {len(a)} entries, one for each state of A, got shape {drift.shape}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        carried = np.tensordot(integral(a, times), drift, axes=(-1, -1))
    carried = np.moveaxis(carried, times.ndim, -1)
    _in_range(carried, carried, times)
    return np.asarray(carried)


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
    times = _times(time_s)
    start = checked_covariance("P0", P0, step.noise.shape[-1])
    between = (*times.shape, *(1,) * (start.ndim - 2), *step.noise.shape[-2:])
    transition, noise = step.transition.reshape(between), step.noise.reshape(between)
    with np.errstate(over="ignore", invalid="ignore"):
        grown = transition @ start @ np.swapaxes(transition, -1, -2) + noise
    _in_range(grown, grown, times)
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
    a, q = _system(A, Q)
    _, _, information = _sensor(a, C, R)
    times = _times(time_s)
    start = checked_covariance("P0", P0, len(a))
    seen = np.empty((*times.shape, *start.shape))
    for index in np.ndindex(times.shape):
        with np.errstate(over="ignore", invalid="ignore"):
            seen[index] = riccati_flow(start, a, q, information, float(times[index]))
        _in_range(seen[index], seen[index], times[index])
    return seen


def double_integrator_covariance(P0: ArrayLike, intensity: float, time_s: ArrayLike) -> Array:
    """The closed form for position and velocity under white acceleration noise, while nothing is seen.

    `sigma_p^2 = P11 + 2 P12 t + P22 t^2 + q t^3 / 3`, `P12 + P22 t + q t^2 / 2`, `P22 + q t`: the uncertain velocity
    tells with t^2, the noise with t^3.

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
    t = _times(time_s)
    grown = np.empty((*t.shape, 2, 2))
    velocity = start[1, 1]
    grown[..., 0, 0] = start[0, 0] + t * (2.0 * start[0, 1] + t * (velocity + t * intensity / 3.0))
    grown[..., 0, 1] = grown[..., 1, 0] = start[0, 1] + t * (velocity + t * intensity / 2.0)
    grown[..., 1, 1] = velocity + t * intensity
    return grown


def steady_state(A: ArrayLike, Q: ArrayLike, C: ArrayLike, R: ArrayLike) -> Array:
    """The covariance that measuring without end leads to, from whatever start: the algebraic Riccati equation.

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
    a, q = _system(A, Q)
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


def blind_time(
    P0: ArrayLike,
    A: ArrayLike,
    Q: ArrayLike,
    direction: ArrayLike,
    tolerance: float,
    sigmas: float,
    horizon_s: float,
) -> float:
    """How long an estimate may be relied on unseen: the first time at which `sigmas` deviations reach a tolerance.

    Growth need not be monotonic (an oscillator's is not), so no later time is looked at before every window up to it
    is shown to be free, by a Taylor series with its remainder. The time returned is never late.

    Args:
        P0: Covariance when the sensor was lost, shape (n, n).
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, shape (n, n).
        direction: D, the direction(s) of the state in which the error matters, shape (n,) or (m, n). For several,
            the largest standard deviation over all unit combinations of them: the square root of the largest
            eigenvalue of D P D'.
        tolerance: In the units of D x, > 0.
        sigmas: k, > 0; choose it with `safe_wrappers.appendix.sigma_coverage.sigmas_for`.
        horizon_s: How far to look, s, at least 0.

    Returns:
        s; `k sigma <= tolerance` holds up to it. 0 if the tolerance is reached already; inf if it is not reached
        within the horizon.

    Raises:
        ConfigurationError: Bad matrices, or a tolerance, k or horizon that is not finite or has the wrong sign.
    """
    a, q = _system(A, Q)
    start = checked_covariance("P0", P0, len(a))
    rows = np.atleast_2d(finite_arrays(direction=direction)[0])
    if start.ndim != 2 or rows.ndim != 2 or rows.shape[1] != len(a):
        raise ConfigurationError(
            f"for {len(a)} states P0 has shape ({len(a)}, {len(a)}) and direction ({len(a)},) or (m, {len(a)}), "
            f"got {start.shape} and {np.shape(direction)}"
        )
    for name, value in (("tolerance", tolerance), ("sigmas", sigmas)):
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigurationError(f"{name} must be finite and above 0, got {value!r}")
    horizon = float(_times(horizon_s, "horizon_s"))
    goal = min(float(tolerance) / float(sigmas), _LARGEST) ** 2 * (1.0 - _GOAL)
    return first_crossing(start, a, q, rows, goal, horizon)


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


def _symmetric(name: str, matrix: ArrayLike, n: int | None) -> tuple[Array, float, float]:
    """The matrix, its smallest eigenvalue and the largest size of one."""
    (given,) = finite_arrays(**{name: matrix})
    if given.ndim < 2 or given.shape[-1] != given.shape[-2] or given.shape[-1] == 0:
        raise ConfigurationError(f"{name} must be a square matrix, got shape {given.shape}")
    if n is not None and given.shape[-1] != n:
        raise ConfigurationError(f"{name} must be {n} x {n}, got shape {given.shape}")
    turned = np.swapaxes(given, -1, -2)
    asymmetry = float(np.abs(given - turned).max(initial=0.0))
    if asymmetry > _SYMMETRY * float(np.abs(given).max(initial=0.0)):
        raise ConfigurationError(
            f"{name} must be symmetric, its entries differ across it by up to {asymmetry:.6g}"
        )
    symmetric = 0.5 * (given + turned)
    values = np.linalg.eigvalsh(symmetric)
    return symmetric, float(values.min(initial=np.inf)), float(np.abs(values).max(initial=0.0))


def _square(name: str, matrix: ArrayLike) -> Array:
    (given,) = finite_arrays(**{name: matrix})
    if given.ndim != 2 or given.shape[0] != given.shape[1] or given.size == 0:
        raise ConfigurationError(f"{name} must be a square matrix, got shape {given.shape}")
    return given


def _system(A: ArrayLike, Q: ArrayLike) -> tuple[Array, Array]:
    a = _square("A", A)
    return a, checked_covariance("Q", _square("Q", Q), len(a))


def _sensor(a: Array, C: ArrayLike, R: ArrayLike) -> tuple[Array, Array, Array]:
    """C, R and the rate of information C' R^-1 C."""
    (c,) = finite_arrays(C=C)
    if c.ndim != 2 or c.shape[1] != len(a) or len(c) == 0:
        raise ConfigurationError(f"C must have shape (m, {len(a)}), a row per measurement, got {c.shape}")
    r = checked_noise("R", _square("R", R), len(c))
    return c, r, np.asarray(c.T @ np.linalg.solve(r, c))


def _times(time_s: ArrayLike, name: str = "time_s") -> Array:
    (times,) = finite_arrays(**{name: time_s})
    if (times < 0.0).any():
        raise ConfigurationError(f"{name} must be at least 0 s, got {time_s!r}: time does not run backwards")
    return times


def _in_range(first: Array, second: Array, times: Array) -> None:
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise ConfigurationError(
            f"within time_s = {np.max(times):.6g} s an unstable mode of A grows beyond the range of floats"
        )
