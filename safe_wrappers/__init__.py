"""Composable Gymnasium wrappers that make reinforcement learning safe on MuJoCo robots.

    import gymnasium as gym, safe_wrappers as sw
    env = sw.protect(gym.make("SafePointGoal1-v0"))

Importing registers the ids of our tasks and changes nothing else; it imports neither torch nor Stable-Baselines3
(`safe_wrappers.sb3` and `safe_wrappers.train` do).
"""

import warnings as _warnings
from typing import Any as _Any

from safe_wrappers import info as _info
from safe_wrappers.constraints import (
    Barrier,
    Box,
    Clearance,
    CoastingClearance,
    Constraint,
    ContactFeasibility,
    Disc,
    Discs,
    EscapeClearance,
    HeadingDriveClearance,
    ImpactSpeedLimit,
    JointPositionLimit,
    JointSpeedLimit,
    Plane,
    SingularityMargin,
    SpeedLimit,
    Sphere,
    Stance,
    SupportMargin,
    TrackedDiscs,
    TrackPermission,
    Traction,
    Upright,
    WallClearance,
    Workspace,
)
from safe_wrappers.envs import register_envs as _register_envs
from safe_wrappers.errors import SafeWrappersError, UnsafeStateWarning
from safe_wrappers.filter.batch import BatchProjection, project_batch
from safe_wrappers.filter.constraint import BoundConstraint, HalfSpaces
from safe_wrappers.filter.projection import Projection, project
from safe_wrappers.plants.analytic import AnalyticPlant
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.protect import protect
from safe_wrappers.wrappers.adaption_penalty import AdaptionPenalty
from safe_wrappers.wrappers.balance_monitor import BalanceMonitor
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.chunk_handover import ChunkHandover
from safe_wrappers.wrappers.contact_monitor import ContactMonitor
from safe_wrappers.wrappers.cost_function import CostFunction
from safe_wrappers.wrappers.lease.stopping_budget import StoppingBudget
from safe_wrappers.wrappers.lease_expiry import LeaseExpiry
from safe_wrappers.wrappers.occlusion.sensor import Sensor
from safe_wrappers.wrappers.occlusion.track import Track
from safe_wrappers.wrappers.occlusion_penalty import OcclusionPenalty
from safe_wrappers.wrappers.record_interventions import RecordInterventions
from safe_wrappers.wrappers.slip_limiter import SlipLimiter
from safe_wrappers.wrappers.teleop.link import Link
from safe_wrappers.wrappers.teleop.port import TeleopPort
from safe_wrappers.wrappers.teleop.round_trip import RoundTripCeiling
from safe_wrappers.wrappers.teleop_channel import TeleopChannel
from safe_wrappers.wrappers.whole_body_filter import WholeBodyFilter

__all__ = [
    "AdaptionPenalty",
    "AnalyticPlant",
    "BalanceMonitor",
    "Barrier",
    "BatchProjection",
    "BoundConstraint",
    "Box",
    "CBFActionFilter",
    "ChunkHandover",
    "Clearance",
    "CoastingClearance",
    "Constraint",
    "ContactFeasibility",
    "ContactMonitor",
    "CostFunction",
    "Disc",
    "Discs",
    "DisplacementPlant",
    "EscapeClearance",
    "HalfSpaces",
    "HeadingDriveClearance",
    "ImpactSpeedLimit",
    "JointPositionLimit",
    "JointSpeedLimit",
    "LeaseExpiry",
    "Link",
    "MujocoPlant",
    "OcclusionPenalty",
    "Plane",
    "Plant",
    "Projection",
    "RecordInterventions",
    "RoundTripCeiling",
    "SafeWrappersError",
    "Sensor",
    "SingularityMargin",
    "SlipLimiter",
    "SpeedLimit",
    "Sphere",
    "Stance",
    "StoppingBudget",
    "SupportMargin",
    "TeleopChannel",
    "TeleopPort",
    "Track",
    "TrackPermission",
    "TrackedDiscs",
    "Traction",
    "UnsafeStateWarning",
    "Upright",
    "WallClearance",
    "WholeBodyFilter",
    "Workspace",
    "project",
    "project_batch",
    "protect",
]

_register_envs()


def __getattr__(name: str) -> _Any:
    if name == "interventions":
        _warnings.warn(
            "safe_wrappers.interventions is deprecated; write safe_wrappers.info",
            DeprecationWarning,
            stacklevel=2,
        )
        return _info
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
