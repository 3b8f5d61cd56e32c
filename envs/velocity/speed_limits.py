"""The published speed limits of the velocity tasks."""

from typing import Final

SPEED_LIMITS: Final = {
    "HalfCheetah": 3.2096,
    "Hopper": 0.7402,
    "Walker2d": 2.3415,
    "Swimmer": 0.2282,
    "Ant": 2.6222,
    "Humanoid": 1.4149,
}
"""By robot, m/s (Safety-Gymnasium, its velocity tasks v1): along x, for Ant and Humanoid in the plane."""
