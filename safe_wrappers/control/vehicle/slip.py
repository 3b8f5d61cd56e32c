"""Longitudinal slip of a driven wheel: the slip ratio's two forms, the window it leaves, the wheel's own equation.

Speeds are signed along the wheel's heading: the wheel's circumferential speed `r w` (radius times angular rate)
and the ground speed `v_x` of its centre. Slip has the sign of the force on the vehicle: positive when the wheel
runs ahead of the ground. Reversing mirrors everything.

Source: appendix "Wheel slip ratio and friction boundaries". Its two forms are two measures, not one: they agree to
first order for small slip, and exactly through `normalized_slip`. In the piecewise form the denominator is the
slower of the two speeds, so it has no bound; in the normalised form it is the faster one, so 1 is a wheel that spins
on the spot and -1 a locked one. Limits here are in the normalised form.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.numerics.finite import finite_arrays
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]


def slip_ratio(wheel_speed: ArrayLike, ground_speed: ArrayLike, regularization: float) -> Array:
    """Normalised slip `(r w - v) / max(|v|, |r w|, regularization)`.

    Args:
        wheel_speed: r w, m/s, any shape.
        ground_speed: v_x, m/s, broadcast against it.
        regularization: Speed below which slip is counted against it, m/s, > 0: at rest there is no ratio, and slip
            fades out with the sliding speed.

    Returns:
        Slip, in [-1, 1] while wheel and ground move the same way; up to 2 in size when they oppose each other.

    Raises:
        ConfigurationError: Numbers that are not finite, or a regularization that is not positive.
    """
    wheel, ground = finite_arrays(wheel_speed=wheel_speed, ground_speed=ground_speed)
    _positive("regularization", regularization, "m/s")
    return np.asarray(
        (wheel - ground) / np.maximum(np.maximum(np.abs(wheel), np.abs(ground)), regularization)
    )


def piecewise_slip_ratio(wheel_speed: ArrayLike, ground_speed: ArrayLike) -> Array:
    """The piecewise form: over `v_x` where the wheel drives, over `r w` where it brakes.

    Args:
        wheel_speed: r w, m/s, any shape.
        ground_speed: v_x, m/s, broadcast against it.

    Returns:
        Slip, unbounded: a locked or a spinning wheel has no value. NaN where the form does not hold: at rest, at a
        standstill of either, or when wheel and ground oppose each other.

    Raises:
        ConfigurationError: Numbers that are not finite.
    """
    wheel, ground = finite_arrays(wheel_speed=wheel_speed, ground_speed=ground_speed)
    slower = np.where(np.abs(wheel) > np.abs(ground), ground, wheel)
    holds = wheel * ground > 0.0
    return np.asarray(np.where(holds, (wheel - ground) / np.where(holds, np.abs(slower), 1.0), np.nan))


def normalized_slip(piecewise: ArrayLike) -> Array:
    """The normalised slip that belongs to a piecewise one: `s / (1 + |s|)`, any shape."""
    s = np.asarray(piecewise, dtype=np.float64)
    return np.asarray(s / (1.0 + np.abs(s)))


def slip_window(ground_speed: ArrayLike, max_slip: ArrayLike, regularization: float) -> tuple[Array, Array]:
    """The circumferential speeds whose slip is at most `max_slip` in size.

    Args:
        ground_speed: v_x, m/s, any shape.
        max_slip: In (0, 1), broadcast against it.
        regularization: As in `slip_ratio`, m/s.

    Returns:
        Smallest and largest r w, m/s: at them the slip is `-max_slip` and `max_slip`.

    Raises:
        ConfigurationError: A number out of its range.
    """
    ground, slip = finite_arrays(ground_speed=ground_speed, max_slip=max_slip)
    _positive("regularization", regularization, "m/s")
    if not ((slip > 0.0) & (slip < 1.0)).all():
        raise ConfigurationError(
            "max_slip is a normalised slip ratio in (0, 1), where 1 is a wheel that spins on the spot; got "
            f"{max_slip!r}"
        )
    return -_fastest(-ground, slip, regularization), _fastest(ground, slip, regularization)


def _fastest(ground: Array, slip: Array, floor: float) -> Array:
    braking_or_slow = ground + slip * np.maximum(np.abs(ground), floor)
    return np.asarray(np.where(ground > floor * (1.0 - slip), ground / (1.0 - slip), braking_or_slow))


def wheel_acceleration(
    torque: ArrayLike,
    traction: ArrayLike,
    radius: float,
    inertia: float,
    damping: float = 0.0,
    wheel_rate: ArrayLike = 0.0,
) -> Array:
    """Angular acceleration of a driven wheel, rad/s^2: `(torque - r F_x - damping w) / I`.

    Args:
        torque: Of the drive on the wheel, N m.
        traction: F_x, the ground's force on the vehicle, N.
        radius: r, m, > 0.
        inertia: I about the axle, rotor included, kg m^2, > 0.
        damping: Of the axle, N m s/rad.
        wheel_rate: w, rad/s.

    Raises:
        ConfigurationError: A number out of its range.
    """
    tau, force, rate = finite_arrays(torque=torque, traction=traction, wheel_rate=wheel_rate)
    _positive("radius", radius, "m")
    _positive("inertia", inertia, "kg m^2")
    return np.asarray((tau - radius * force - damping * rate) / inertia)


def spins_out(force_command: ArrayLike, peak_friction: ArrayLike, load: ArrayLike) -> NDArray[np.bool_]:
    """Whether a drive force in steady state asks for more than the ground has: `|F_cmd| > mu_peak F_z`.

    Past that the wheel runs away into the falling part of the traction curve: no slip carries the torque. The test
    compares magnitudes on purpose; a measure of direction alone (cosine similarity) is blind to it.

    Args:
        force_command: Drive torque over wheel radius, N.
        peak_friction: mu_peak, > 0.
        load: F_z, N, >= 0; without load any drive force spins the wheel out.

    Raises:
        ConfigurationError: A number out of its range.
    """
    force, friction, normal = finite_arrays(
        force_command=force_command, peak_friction=peak_friction, load=load
    )
    if not ((friction > 0.0).all() and (normal >= 0.0).all()):
        raise ConfigurationError(f"peak_friction must be > 0 and load >= 0 N; got {friction} and {normal}")
    return np.asarray(np.abs(force) > friction * normal)


def _positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigurationError(f"{name} must be a finite number > 0 in {unit}, got {value!r}")
