"""Composable Gymnasium wrappers that make reinforcement learning safe on MuJoCo robots.

    import gymnasium as gym, safe_wrappers as sw
    env = sw.protect(gym.make("SafePointGoal1-v0"))

Importing registers the ids of our tasks and changes nothing else; it imports neither torch nor Stable-Baselines3
(`safe_wrappers.sb3` and `safe_wrappers.train` do).
"""

from safe_wrappers import constraints, plants
from safe_wrappers.control.handover import SeamLimits
from safe_wrappers.control.projection import project
from safe_wrappers.diagnosis import diagnose
from safe_wrappers.envs import register_envs as _register_envs
from safe_wrappers.errors import SafeWrappersError, UnsafeStateWarning
from safe_wrappers.filter.constraint import Constraint, HalfSpaces
from safe_wrappers.plants import AnalyticPlant, MujocoPlant, Plant, SimulatorPlant
from safe_wrappers.wrappers import faults, occlusion, teleop
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.chunk_handover import ChunkHandover
from safe_wrappers.wrappers.learner import ActionRepeat, AdaptionPenalty, FilterObservation, StuckMonitor
from safe_wrappers.wrappers.lease_expiry import LeaseExpiry
from safe_wrappers.wrappers.monitors import BalanceMonitor, ContactMonitor
from safe_wrappers.wrappers.occlusion import OcclusionPenalty
from safe_wrappers.wrappers.presets import ActionShield, SlipLimiter, WholeBodyFilter
from safe_wrappers.wrappers.protect import protect
from safe_wrappers.wrappers.recording import CostFunction, RecordInterventions
from safe_wrappers.wrappers.safety_overlay import SafetyOverlay
from safe_wrappers.wrappers.stopping import StoppingBudget
from safe_wrappers.wrappers.teleop import TeleopChannel
from safe_wrappers.wrappers.vector_cbf_action_filter import VectorCBFActionFilter

__all__ = [
    "ActionRepeat",
    "ActionShield",
    "AdaptionPenalty",
    "AnalyticPlant",
    "BalanceMonitor",
    "CBFActionFilter",
    "ChunkHandover",
    "Constraint",
    "ContactMonitor",
    "CostFunction",
    "FilterObservation",
    "HalfSpaces",
    "LeaseExpiry",
    "MujocoPlant",
    "OcclusionPenalty",
    "Plant",
    "RecordInterventions",
    "SafeWrappersError",
    "SafetyOverlay",
    "SeamLimits",
    "SimulatorPlant",
    "SlipLimiter",
    "StoppingBudget",
    "StuckMonitor",
    "TeleopChannel",
    "UnsafeStateWarning",
    "VectorCBFActionFilter",
    "WholeBodyFilter",
    "constraints",
    "diagnose",
    "faults",
    "occlusion",
    "plants",
    "project",
    "protect",
    "teleop",
]

_register_envs()
