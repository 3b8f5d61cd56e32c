"""Stable-Baselines3 glue: what the filter did, in the log and the replay buffer. The only room that imports SB3."""

try:
    import stable_baselines3  # noqa: F401
except ImportError as missing:
    needs = "safe_wrappers.sb3 needs stable_baselines3 and torch: pip install 'safe-wrappers[train]'"
    raise ImportError(needs) from missing

from safe_wrappers.sb3.critic_value import critic_value
from safe_wrappers.sb3.executed_action_her_replay_buffer import ExecutedActionHerReplayBuffer
from safe_wrappers.sb3.executed_action_replay_buffer import (
    ExecutedActionDictReplayBuffer,
    ExecutedActionReplayBuffer,
)
from safe_wrappers.sb3.gymnasium_vec_env import GymnasiumVecEnv
from safe_wrappers.sb3.intervention_callback import InterventionCallback, InterventionEvalCallback
from safe_wrappers.sb3.lagrangian_multiplier import LagrangianMultiplier
from safe_wrappers.sb3.log_probability import log_probability
from safe_wrappers.sb3.margin_curriculum import MarginCurriculum

__all__ = [
    "ExecutedActionDictReplayBuffer",
    "ExecutedActionHerReplayBuffer",
    "ExecutedActionReplayBuffer",
    "GymnasiumVecEnv",
    "InterventionCallback",
    "InterventionEvalCallback",
    "LagrangianMultiplier",
    "MarginCurriculum",
    "critic_value",
    "log_probability",
]
