"""Impacts: restitution, impulse and effective mass of rigid ones; peak force and the use of brakes in elastic ones.

Source: appendix "Non-smooth collision manifolds and velocity jumps" and "Elastodynamic impact force and compliance
deformation". The elastic part is one mass against one massless linear spring without damping:

    m x'' = -k x - m a,    x(0) = 0, x'(0) = v,    w = sqrt(k / m),

up to the first peak of the deflection x. Not modelled: stiffness that grows with depth, damping, a pad at the end of
its stroke, ageing, a second contact, motors that keep pushing (`braking` below zero counts a constant push). The
functions relate force to speed; they do not certify a contact as safe.

**Braking after contact is too late.** The peak comes a quarter of a period after the touch, typically 20 to 50 ms.
A brake that acts later does not reduce it (`attenuation_after_delay`), so protection needs clearance before contact.

Arguments are numbers or arrays that broadcast. Speeds are approach speeds, positive towards the obstacle; negative
ones count as at rest. Stiffness (`inf`: rigid) and mass (`inf`: it does not give way) are positive, and not both
infinite. Anything else raises `ConfigurationError`.
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, finite_arrays, float_array
from safe_wrappers.control.contact.contact import in_series, positive
from safe_wrappers.errors import ConfigurationError


def restitution_velocity(velocity: ArrayLike, restitution: ArrayLike) -> Array:
    """Normal velocity after a frictionless impact against a plane at rest, `v+ = -e v-`, shape (...), m/s.

    Of two free bodies it is the relative velocity. The tangential velocity, and a plane that is driven, follow
    other equations.

    Args:
        velocity: Normal velocity v- before, m/s, shape (...): negative approaches; what separates is returned as
            it is.
        restitution: e, from 0 (plastic) to 1 (elastic), shape (...).
    """
    v, e = finite_arrays(velocity=velocity, restitution=restitution)
    if not ((e >= 0.0) & (e <= 1.0)).all():
        raise ConfigurationError(f"restitution must be between 0 and 1, got {e}")
    return np.asarray(np.where(v < 0.0, -e * v, v))


def normal_impulse(mass: ArrayLike, velocity: ArrayLike, restitution: ArrayLike) -> Array:
    """Impulse of that impact, `P = m (v+ - v-)`, shape (...), N s; never negative.

    Args:
        mass: Effective mass along the normal, finite, kg, shape (...).
        velocity: See `restitution_velocity`.
        restitution: See `restitution_velocity`.
    """
    m, v = finite_arrays(mass=positive("mass", mass), velocity=velocity)
    return np.asarray(m * (restitution_velocity(v, restitution) - v))


def effective_mass(inertia: ArrayLike, jacobian: ArrayLike) -> Array:
    """Effective mass of a machine at one point along one direction, `1 / (J M^-1 J')`, kg.

    Each direction separately: simultaneous contacts share the inertia.

    Args:
        inertia: Joint-space inertia M, symmetric and positive definite, shape (..., n, n).
        jacobian: Rows J with `velocity along the direction = J @ qvel`, shape (..., n) or, for k directions, (k, n).

    Returns:
        Shape of the rows without their last axis; inf where no joint moves the point along the direction.
    """
    m, j = finite_array("inertia", inertia), finite_array("jacobian", jacobian)
    n = j.shape[-1] if j.ndim else 0
    if m.ndim < 2 or n == 0 or m.shape[-2:] != (n, n):
        raise ConfigurationError(
            f"expected an inertia of shape (..., n, n) and a jacobian of shape (..., n), got {m.shape} and {j.shape}"
        )
    apart = np.abs(m - m.swapaxes(-1, -2)).max(initial=0.0)
    if apart > 1e-9 * np.abs(m).max(initial=0.0):
        raise ConfigurationError(f"inertia must be symmetric, its transpose differs by up to {apart:.3g}")
    try:
        lower = np.linalg.cholesky(m)
    except np.linalg.LinAlgError:
        raise ConfigurationError("inertia must be positive definite") from None
    # |L^-1 J'|^2 cannot become negative by rounding.
    mobility = (np.linalg.solve(lower, j[..., None])[..., 0] ** 2).sum(axis=-1)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / mobility)


def reduced_mass(mass: ArrayLike, other: ArrayLike) -> Array:
    """Mass of the relative motion of two free bodies, `1 / (1/m1 + 1/m2)`, shape (...), kg.

    Args:
        mass: kg, shape (...).
        other: kg, shape (...); inf is a wall.
    """
    return in_series(positive("mass", mass), positive("other", other))


def peak_deflection(speed: ArrayLike, mass: ArrayLike, stiffness: ArrayLike) -> Array:
    """The deepest deflection, from `m v^2 / 2 = k x^2 / 2`, shape (...), m.

    Args:
        speed: v, m/s.
        mass: m, kg.
        stiffness: k, N/m.
    """
    return braked_deflection(speed, mass, stiffness, 0.0)


def peak_force(speed: ArrayLike, mass: ArrayLike, stiffness: ArrayLike) -> Array:
    """The largest force of the contact, `v sqrt(k m)`, shape (...), N.

    Args:
        speed: v, m/s.
        mass: m, kg.
        stiffness: k, N/m.
    """
    v, m, k = _checked(speed, mass, stiffness)
    return _times(v, np.sqrt(k * m))


def speed_limit(force: ArrayLike, mass: ArrayLike, stiffness: ArrayLike) -> Array:
    """The approach speed whose `peak_force` is a given force, `F / sqrt(k m)`, shape (...), m/s.

    Args:
        force: F, at least 0, N.
        mass: m, kg.
        stiffness: k, N/m.
    """
    f, m, k = _checked(force, mass, stiffness, moving="force", least=0.0)
    return np.asarray(f / np.sqrt(k * m))


def time_to_peak(mass: ArrayLike, stiffness: ArrayLike) -> Array:
    """From the first touch to the peak without braking, a quarter of a period, shape (...), s.

    Args:
        mass: m, kg.
        stiffness: k, N/m.
    """
    _, m, k = _checked(0.0, mass, stiffness)
    return np.asarray(np.pi / 2.0 * np.sqrt(m / k))


def braked_deflection(
    speed: ArrayLike,
    mass: ArrayLike,
    stiffness: ArrayLike,
    braking: ArrayLike,
    latency: ArrayLike = 0.0,
    deflection: ArrayLike = 0.0,
) -> Array:
    """The first peak of the deflection when a brake works against it, shape (...), m.

    The brake's work `m a (x_max - x_latency)` is taken off the energy, where x_latency is how deep the contact
    already is when the brake comes on: with b = m a / k, p = v / w, the deflection x at the start and the unbraked
    peak `sqrt(p^2 + x^2)`,

        x_max = sqrt(b^2 + p^2 + x^2 + 2 b x_latency) - b,    x_latency = p sin(w latency) + x cos(w latency).

    From the unbraked peak on, at the `time_to_peak` where x is 0, a brake changes nothing.

    Args:
        speed: v at the start, m/s.
        mass: m, kg, finite where there is braking.
        stiffness: k, N/m.
        braking: Constant deceleration a, m/s^2, of brakes alone, without the contact's own. Below zero it is a
            push that goes on.
        latency: From the start to the brake's action, at least 0, s.
        deflection: x, how deep the contact is at the start, at least 0, m; 0 at the first touch.
    """
    v, m, k = _checked(speed, mass, stiffness)
    (a,), late = finite_arrays(braking=braking), float_array("latency", latency)
    x = float_array("deflection", deflection)
    if not (late >= 0.0).all():
        raise ConfigurationError(f"latency must be 0 s or more, got {late}")
    if not (np.isfinite(x) & (x >= 0.0)).all():
        raise ConfigurationError(f"deflection must be finite and 0 m or more, got {x}")
    root = np.sqrt(m / k)
    to_come = _times(v, root)
    unbraked = np.hypot(to_come, x)
    if not a.any():
        return np.asarray(np.broadcast_arrays(unbraked, a, late)[0].copy())
    if np.isinf(m).any():
        raise ConfigurationError("mass must be finite for a brake to act on it")
    b = a * root**2
    quarter = np.where(x > 0.0, np.arctan2(to_come, x), np.pi / 2.0)
    in_time = (late == 0.0) | (late < quarter * root)
    phase = np.where(in_time, late, 0.0) / np.where(root > 0.0, root, 1.0)
    deep = to_come * np.sin(phase) + x * np.cos(phase)
    # From where the brake comes on it swings about -b.
    whole = np.hypot(deep + b, to_come * np.cos(phase) - x * np.sin(phase))
    # (x_max + b)^2 - b^2, divided rather than subtracted: for a strong brake the difference cancels.
    gained = unbraked**2 + 2.0 * b * deep
    braked = np.where(b > 0.0, gained / np.where(b > 0.0, whole + b, 1.0), whole - b)
    return np.asarray(np.where(in_time, braked, unbraked))


def braked_peak_force(
    speed: ArrayLike,
    mass: ArrayLike,
    stiffness: ArrayLike,
    braking: ArrayLike,
    latency: ArrayLike = 0.0,
    deflection: ArrayLike = 0.0,
) -> Array:
    """The contact's force at that peak, `k x_max`, shape (...), N.

    Args:
        speed: See `braked_deflection`.
        mass: See `braked_deflection`.
        stiffness: k, N/m, finite.
        braking: See `braked_deflection`.
        latency: See `braked_deflection`.
        deflection: See `braked_deflection`.
    """
    k = finite_array("stiffness", stiffness)
    return np.asarray(k * braked_deflection(speed, mass, k, braking, latency, deflection))


def attenuation_after_delay(
    speed: ArrayLike, mass: ArrayLike, stiffness: ArrayLike, braking: ArrayLike, latency: ArrayLike
) -> Array:
    """Relative reduction of the peak force by a brake `latency` seconds after the first touch, shape (...).

    Exactly 0 from the `time_to_peak` on, and where there is no peak. Negative for a push.

    Args:
        speed: See `braked_deflection`.
        mass: See `braked_deflection`.
        stiffness: k, N/m.
        braking: See `braked_deflection`.
        latency: See `braked_deflection`.
    """
    braked = braked_deflection(speed, mass, stiffness, braking, latency)
    free = peak_deflection(speed, mass, stiffness)
    peaked = free > 0.0
    return np.asarray(np.where(peaked, 1.0 - braked / np.where(peaked, free, 1.0), 0.0))


def _checked(
    speed: ArrayLike, mass: ArrayLike, stiffness: ArrayLike, moving: str = "speed", least: float = -np.inf
) -> tuple[Array, Array, Array]:
    """Speed (or force), mass and stiffness as float64."""
    v = finite_array(moving, speed)
    if not (v >= least).all():
        raise ConfigurationError(f"{moving} must be at least {least}, got {v}")
    m, k = positive("mass", mass), positive("stiffness", stiffness)
    if (np.isinf(m) & np.isinf(k)).any():
        raise ConfigurationError("mass and stiffness are both infinite: such an impact has no finite answer")
    return v, m, k


def _times(speed: Array, factor: Array) -> Array:
    """Their product; 0 where the speed is not positive, also for an infinite factor."""
    some = speed > 0.0
    return np.asarray(np.where(some, np.where(some, speed, 1.0) * factor, 0.0))
