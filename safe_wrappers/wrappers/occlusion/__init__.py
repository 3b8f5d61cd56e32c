"""What an OcclusionPenalty is made of: sensors and tracks."""

from safe_wrappers.wrappers.occlusion.imu import Imu
from safe_wrappers.wrappers.occlusion.sensor import Sensor
from safe_wrappers.wrappers.occlusion.track import Track

__all__ = ["Imu", "Sensor", "Track"]
