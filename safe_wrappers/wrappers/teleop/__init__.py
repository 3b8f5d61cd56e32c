"""What a TeleopChannel is made of: links, ports, the ceiling on the round trip."""

from safe_wrappers.wrappers.teleop.link import Link
from safe_wrappers.wrappers.teleop.port import TeleopPort
from safe_wrappers.wrappers.teleop.round_trip import RoundTripCeiling

__all__ = ["Link", "RoundTripCeiling", "TeleopPort"]
