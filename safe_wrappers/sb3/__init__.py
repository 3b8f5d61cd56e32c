"""Stable-Baselines3 glue: what the filter did, in the log and the replay buffer. It and `train` import SB3."""

try:
    import stable_baselines3  # noqa: F401
except ImportError as missing:
    needs = "safe_wrappers.sb3 needs stable_baselines3 and torch: pip install 'safe-wrappers[train]'"
    raise ImportError(needs) from missing

from safe_wrappers.sb3.callbacks import InterventionCallback, LagrangianMultiplier
from safe_wrappers.sb3.replay_buffers import (
    ExecutedActionDictReplayBuffer,
    ExecutedActionHerReplayBuffer,
    ExecutedActionReplayBuffer,
)

__all__ = [
    "ExecutedActionDictReplayBuffer",
    "ExecutedActionHerReplayBuffer",
    "ExecutedActionReplayBuffer",
    "InterventionCallback",
    "LagrangianMultiplier",
]
