"""The piecewise slip ratio, the wheel's equation, and the test for spin-out.

Source: appendix "Wheel slip ratio and friction boundaries".
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_arrays, positive
from safe_wrappers.errors import ConfigurationError


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
    positive("radius", radius, "m")
    positive("inertia", inertia, "kg m^2")
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
