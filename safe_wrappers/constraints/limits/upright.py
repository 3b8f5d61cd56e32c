"""Upright: a body stays above a height and within a tilt."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from safe_wrappers.checks import Array, positive
from safe_wrappers.constraints.rollout import BoundRollout, RolloutConstraint
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.plant import Plant


@dataclass
class Upright(RolloutConstraint):
    """Keep a body's height in a range and its own z axis within an angle of the vertical.

    Best effort: an executed control that is not flagged keeps both at every physics substep of its step, for a plant
    that is right. It does not balance: a robot on legs can be unrecoverable long before it falls.

    Args:
        body: Its name.
        lowest: Of the body frame's origin above the world's zero, m; None: no bound.
        highest: Likewise.
        tilt: Largest angle between the body's z axis and the world's, rad; None: no bound.
        margin: Kept free, m for the heights and rad for the tilt.
        horizon: Control steps to forecast.
        max_decrease: The most that height (m) and tilt (rad) can change within `horizon` steps. None: unknown.
    """

    body: str = "torso"
    lowest: float | None = None
    highest: float | None = None
    tilt: float | None = None
    margin: float = 0.0
    horizon: int = 5
    max_decrease: float | None = None

    unit: ClassVar[str] = "m or rad"

    def __post_init__(self) -> None:
        self._check_shared()
        if self.lowest is None and self.highest is None and self.tilt is None:
            raise ConfigurationError("give at least one of lowest (m), highest (m) and tilt (rad)")
        for name, height in (("lowest", self.lowest), ("highest", self.highest)):
            if height is not None and not (isinstance(height, int | float) and math.isfinite(height)):
                raise ConfigurationError(f"{name} is a height in m or None, got {height!r}")
        if self.tilt is not None:
            self.tilt = positive("tilt", self.tilt, "rad")
            if self.tilt > math.pi or self.tilt <= self.margin:
                wanted = f"tilt is an angle above the margin ({self.margin}) and at most pi"
                raise ConfigurationError(f"{wanted}, got {self.tilt}")
        low, high = self.lowest, self.highest
        if low is not None and high is not None and not high - low > 2.0 * self.margin:
            raise ConfigurationError(
                f"nothing is left between lowest = {self.lowest} m and highest = {self.highest} m with a margin "
                f"of {self.margin} m at both ends"
            )

    def bind(self, plant: Plant) -> "BoundUpright":
        return BoundUpright(self, plant)


class BoundUpright(BoundRollout):
    """Upright on a plant."""

    spec: Upright

    def __init__(self, spec: Upright, plant: Plant) -> None:
        super().__init__(spec, plant)
        self._body = self.plant.named("body", self.spec.body, "body")

    def now(self) -> Array:
        pose = self.plant.pose()
        return self._left(pose.xpos[self._body, 2], pose.xmat[self._body, 8])

    def _left(self, height: Array, cosine: Array) -> Array:
        left = []
        if self.spec.lowest is not None:
            left.append(height - self.spec.lowest)
        if self.spec.highest is not None:
            left.append(self.spec.highest - height)
        if self.spec.tilt is not None:
            left.append(self.spec.tilt - np.arccos(np.clip(cosine, -1.0, 1.0)))
        return np.array(left)

    def room(self, forecast: Forecast) -> Array:
        poses = forecast.poses()
        left = self._left(poses.frames[:, self._body, 2], poses.axes[:, self._body, 2, 2])
        return np.asarray(left.T)
