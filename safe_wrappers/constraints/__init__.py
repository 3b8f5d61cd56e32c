"""Safety requirements: each turns a plant into half-spaces on the control."""

from safe_wrappers.constraints.backup.coasting_clearance import CoastingClearance
from safe_wrappers.constraints.backup.escape_clearance import EscapeClearance
from safe_wrappers.constraints.backup.heading_drive_clearance import HeadingDriveClearance
from safe_wrappers.constraints.backup.wall_clearance import WallClearance
from safe_wrappers.constraints.barrier import Barrier
from safe_wrappers.constraints.clearance import Clearance, TrackPermission
from safe_wrappers.constraints.contact_feasibility import ContactFeasibility, Stance, SupportMargin
from safe_wrappers.constraints.impact_speed_limit import ImpactSpeedLimit
from safe_wrappers.constraints.joints import JointPositionLimit, JointSpeedLimit
from safe_wrappers.constraints.obstacles import Box, Disc, Discs, Plane, Sphere, TrackedDiscs
from safe_wrappers.constraints.points import SpeedLimit, Workspace
from safe_wrappers.constraints.predictive_shield import PredictiveShield
from safe_wrappers.constraints.singularity_margin import SingularityMargin
from safe_wrappers.constraints.traction import Traction

__all__ = [
    "Barrier",
    "Box",
    "Clearance",
    "CoastingClearance",
    "ContactFeasibility",
    "Disc",
    "Discs",
    "EscapeClearance",
    "HeadingDriveClearance",
    "ImpactSpeedLimit",
    "JointPositionLimit",
    "JointSpeedLimit",
    "Plane",
    "PredictiveShield",
    "SingularityMargin",
    "SpeedLimit",
    "Sphere",
    "Stance",
    "SupportMargin",
    "TrackPermission",
    "TrackedDiscs",
    "Traction",
    "WallClearance",
    "Workspace",
]
