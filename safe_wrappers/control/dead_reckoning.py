"""Dead reckoning from an inertial unit, with lever arms: v_P = v_O + ω x r, a_P = a_O + α x r + ω x (ω x r).

Source: appendix "Spatial coordinate frames".
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from safe_wrappers.errors import Array

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform, Rotation

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_SHARES, _PARTS = 0.5 * (_NODES + 1.0)[:, None], 0.5 * _WEIGHTS
"""Gauss's nodes, shape (3, 1), and weights, (3,), on an interval of length 1."""


def centre_acceleration(
    acceleration: Array, angular_velocity: Array, angular_acceleration: Array, arm: Array
) -> Array:
    """Acceleration of O, m/s², from that of P, the derivative of its velocity; the arm is P - O, m.

    All of shape (..., 3) in the same axes; angular velocity in rad/s, acceleration in rad/s².
    """
    extra = np.cross(angular_acceleration, arm) + np.cross(angular_velocity, np.cross(angular_velocity, arm))
    return np.asarray(acceleration - extra)


def rigid_transform(rotation: Array, position: Array) -> RigidTransform:
    """A pose as SciPy's transform: the frame's axes as columns of a rotation (3, 3), and its origin (3,), m."""
    from scipy.spatial.transform import RigidTransform, Rotation  # here: SciPy takes a while to import

    return RigidTransform.from_components(position, Rotation.from_matrix(rotation))


class DeadReckoning:
    """Integrates readings to the motion of the body's origin O, in world axes.

    Args:
        extrinsics: Pose of the unit in the body, as it is believed to be.
        gravity: World axes, shape (3,), m/s².

    Attributes:
        position: Of O, shape (3,), m.
        velocity: Of O, shape (3,), m/s.
        orientation: Of the body.
    """

    def __init__(self, extrinsics: RigidTransform, gravity: Array) -> None:
        self.extrinsics, self.gravity = extrinsics, gravity.copy()
        self.position, self.velocity, self._rate = np.zeros(3), np.zeros(3), np.zeros(3)
        self.orientation: Rotation = extrinsics.rotation

    def fix(self, position: Array, velocity: Array, orientation: Rotation, rate: Array) -> None:
        """Begin from a known motion; `rate` is what the gyroscope reads now, its own axes, shape (3,), rad/s."""
        self.position, self.velocity, self._rate = position.copy(), velocity.copy(), rate.copy()
        self.orientation = orientation

    @property
    def angular_velocity(self) -> Array:
        """Of the body, world axes, shape (3,), rad/s."""
        return np.asarray((self.orientation * self.extrinsics.rotation).apply(self._rate))

    def advance(self, specific_force: Array, turn: Array, rate: Array, time_s: float) -> None:
        """Go on by the readings of one interval.

        Args:
            specific_force: Mean of what the accelerometer read in it, in the axes of its middle, shape (3,), m/s².
            turn: Rotation vector by which the unit turned in it, its own axes, shape (3,), rad.
            rate: What the gyroscope reads at its end, shape (3,), rad/s.
            time_s: Its length, s, > 0.
        """
        # The rate in between is the parabola that has both ends and the mean.
        change = rate - self._rate
        bend = 6.0 * (turn / time_s - 0.5 * (self._rate + rate))
        rates = self._rate + _SHARES * (change + (1.0 - _SHARES) * bend)
        rate_changes = (change + (1.0 - 2.0 * _SHARES) * bend) / time_s
        turns = self._rate + _SHARES * (0.5 * change + (0.5 - _SHARES / 3.0) * bend)
        orientations = self._turned(time_s * _SHARES * turns)
        axes = orientations * self.extrinsics.rotation
        at_unit = (self._turned(0.5 * turn) * self.extrinsics.rotation).apply(specific_force) + self.gravity
        arms = orientations.apply(self.extrinsics.translation)
        acceleration = centre_acceleration(at_unit, axes.apply(rates), axes.apply(rate_changes), arms)
        left = time_s * (1.0 - _SHARES)
        self.position = self.position + time_s * (self.velocity + _PARTS @ (left * acceleration))
        self.velocity = self.velocity + time_s * (_PARTS @ acceleration)
        self.orientation = self._turned(turn)
        self._rate = rate.copy()

    def _turned(self, turn: Array) -> Rotation:
        """The body's orientation after a rotation vector in the unit's axes, shape (3,), or several, (k, 3)."""
        return self.orientation * type(self.orientation).from_rotvec(self.extrinsics.rotation.apply(turn))


def lever_arm_velocity(velocity: Array, angular_velocity: Array, arm: Array) -> Array:
    """Velocity of P, m/s, from that of O, and the arm P - O, m, all of shape (..., 3) in the same axes."""
    return np.asarray(velocity + np.cross(angular_velocity, arm))
