"""Safety requirements: each turns a plant into half-spaces on the control."""

from safe_wrappers.constraints.barrier import Barrier
from safe_wrappers.constraints.clearance import Clearance
from safe_wrappers.constraints.coasting_clearance import CoastingClearance
from safe_wrappers.constraints.constraint import CertifyingConstraint, Constraint, HalfSpaces
from safe_wrappers.constraints.contact_feasibility import ContactFeasibility
from safe_wrappers.constraints.escape_clearance import EscapeClearance
from safe_wrappers.constraints.heading_drive_clearance import HeadingDriveClearance
from safe_wrappers.constraints.impact_speed_limit import ImpactSpeedLimit
from safe_wrappers.constraints.joint_position_limit import JointPositionLimit
from safe_wrappers.constraints.joint_speed_limit import JointSpeedLimit
from safe_wrappers.constraints.obstacles import Box, Disc, Discs, Plane, Sphere
from safe_wrappers.constraints.singularity_margin import SingularityMargin
from safe_wrappers.constraints.speed_limit import SpeedLimit
from safe_wrappers.constraints.stance import Stance
from safe_wrappers.constraints.support_margin import SupportMargin
from safe_wrappers.constraints.track_permission import TrackPermission
from safe_wrappers.constraints.tracked_discs import TrackedDiscs
from safe_wrappers.constraints.traction import Traction
from safe_wrappers.constraints.upright import Upright
from safe_wrappers.constraints.wall_clearance import WallClearance
from safe_wrappers.constraints.workspace import Workspace

__all__ = [
    "Barrier",
    "Box",
    "CertifyingConstraint",
    "Clearance",
    "CoastingClearance",
    "Constraint",
    "ContactFeasibility",
    "Disc",
    "Discs",
    "EscapeClearance",
    "HalfSpaces",
    "HeadingDriveClearance",
    "ImpactSpeedLimit",
    "JointPositionLimit",
    "JointSpeedLimit",
    "Plane",
    "SingularityMargin",
    "SpeedLimit",
    "Sphere",
    "Stance",
    "SupportMargin",
    "TrackPermission",
    "TrackedDiscs",
    "Traction",
    "Upright",
    "WallClearance",
    "Workspace",
]
