"""Contacts: residuals of rigid ones; peak force and the use of brakes of elastic ones.

Source: appendix "Rigid Body Contact Mechanics", "Non-smooth collision manifolds and velocity jumps" and
"Elastodynamic impact force and compliance deformation". The elastic part is one mass on one massless linear spring
without damping, `m x'' = -k x - m a`, `x(0) = 0`, `x'(0) = v`, up to the first peak of the deflection x. Not
modelled: stiffness that grows with depth, damping, a pad at the end of its stroke, a second contact. The functions
relate force to speed; they do not certify a contact as safe.

**Braking after contact is too late.** The peak comes a quarter of a period after the touch, typically 20 to 50 ms.
A brake that acts later does not reduce it (`braked_deflection`), so protection needs clearance before contact.

Arguments are numbers or arrays that broadcast; speeds of approach that are negative count as at rest. What is not
finite, or not positive where it must be, raises `ConfigurationError`; the force of `speed_limit` is taken as it is.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays, float_array
from safe_wrappers.errors import ConfigurationError


class ComplementarityResiduals(NamedTuple):
    """Violations of `gap >= 0` and of `gap * force = 0`, shapes (...), 0 where they hold: m and N m."""

    penetration: Array
    product: Array


def complementarity_residuals(gap: ArrayLike, force: ArrayLike) -> ComplementarityResiduals:
    """The residuals of contacts, one by one. Compliant contacts, MuJoCo's among them, violate the law by design.

    The gap is a signed distance, m, shape (...), negative where the bodies penetrate; the force is along the normal,
    N, shape (...), positive where it pushes the bodies apart.
    """
    g, f = finite_arrays(gap=gap, force=force)
    return ComplementarityResiduals(np.maximum(-g, 0.0), np.abs(g * f))


def peak_force(
    speed: ArrayLike,
    mass: ArrayLike,
    stiffness: ArrayLike,
    push: ArrayLike = 0.0,
    deflection: ArrayLike = 0.0,
) -> Array:
    """The largest force of a contact, shape (...), N.

    `v sqrt(k m)`, and with a push F_p that goes on `F_p + sqrt((k x - F_p)^2 + k m v^2)`.

    Args:
        speed: v, m/s.
        mass: m, kg.
        stiffness: k, N/m.
        push: F_p, N.
        deflection: x, how deep the contact is already, m.
    """
    v, p, x = finite_arrays(speed=speed, push=push, deflection=deflection)
    m, k = _positive("mass", mass), _positive("stiffness", stiffness)
    return np.asarray(p + np.hypot(k * x - p, np.maximum(v, 0.0) * np.sqrt(k * m)))


def speed_limit(force: ArrayLike, mass: ArrayLike, stiffness: ArrayLike) -> Array:
    """The approach speed whose `peak_force` is F, `F / sqrt(k m)`, shape (...), m/s, of F (N), m (kg) and k (N/m)."""
    return np.asarray(force / np.sqrt(_positive("stiffness", stiffness) * _positive("mass", mass)))


def time_to_peak(mass: ArrayLike, stiffness: ArrayLike) -> Array:
    """From the first touch to the peak without braking, a quarter of a period, shape (...), s, of m (kg), k (N/m)."""
    return np.asarray(np.pi / 2.0 * np.sqrt(_positive("mass", mass) / _positive("stiffness", stiffness)))


def braked_deflection(
    speed: ArrayLike, mass: ArrayLike, stiffness: ArrayLike, braking: ArrayLike, latency: ArrayLike = 0.0
) -> Array:
    """The first peak of the deflection when a brake works against it, shape (...), m.

    The brake's work is taken off the energy, from where the contact is when the brake comes on: with b = m a / k and
    the unbraked peak `p = v sqrt(m / k)`, `x_max = sqrt(b^2 + p^2 + 2 b p sin(latency sqrt(k / m))) - b`. From the
    unbraked peak on, at the `time_to_peak`, a brake changes nothing.

    Args:
        speed: v at the first touch, m/s.
        mass: m, kg.
        stiffness: k, N/m.
        braking: Constant deceleration a >= 0 of brakes alone, without the contact's own, m/s^2.
        latency: From the touch to the brake's action, at least 0, s.
    """
    v, m, k, a = finite_arrays(speed=speed, mass=mass, stiffness=stiffness, braking=braking)
    late = float_array("latency", latency)
    if not ((late >= 0.0).all() and (a >= 0.0).all()):
        raise ConfigurationError(f"latency and braking must be 0 or more, got {late} and {a}")
    root = np.sqrt(_positive("mass", m) / _positive("stiffness", k))
    free, b = np.maximum(v, 0.0) * root, a * root**2
    in_time = (late < np.pi / 2.0 * root) & (free > 0.0)
    deep = free * np.sin(np.where(in_time, late, 0.0) / root)
    # (x_max + b)^2 - b^2, divided rather than subtracted: for a strong brake the difference cancels.
    gained = free**2 + 2.0 * b * deep
    braked = gained / np.where(in_time, np.sqrt(b**2 + gained) + b, 1.0)
    return np.asarray(np.where(in_time, braked, free))


def _positive(name: str, value: ArrayLike) -> Array:
    """Positive numbers as float64, inf included."""
    array = float_array(name, value)
    if not (array > 0.0).all():
        raise ConfigurationError(f"{name} must be positive, got {array}")
    return array
