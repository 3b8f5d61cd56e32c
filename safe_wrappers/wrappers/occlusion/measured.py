"""Measurements of a sensor as the estimator takes them."""

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.numerics.spatial import from_sensor, lever_arm_velocity, to_sensor
from safe_wrappers.plants.queries.line_of_sight import LineOfSight
from safe_wrappers.wrappers.occlusion.sensor import Sensor

Array = NDArray[np.float64]


def measured(s: Sensor, sight: LineOfSight, d: int, truth: Array, velocities: Array | None) -> Array:
    """What the estimator makes of the measurements, noise aside: world axes, shape (k, m).

    The sensor measures in its own axes; how that becomes a position in the world depends on where the estimator
    takes it to sit.
    """
    body = np.array(sight.data.xpos[sight.body])
    eye, axes = sight.position, sight.rotation
    believed = eye if s.lever_arm else body
    parts = []
    if s.position_std is not None:
        parts.append(from_sensor(to_sensor(truth, axes, eye), axes, believed)[:, :d])
    if velocities is not None:
        linear, angular = sight.velocity(sight.body)
        apparent = velocities - lever_arm_velocity(linear, angular, eye - body)[:d]
        parts.append(apparent + lever_arm_velocity(linear, angular, believed - body)[:d])
    return np.concatenate(parts, axis=1)
