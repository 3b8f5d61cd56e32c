"""One run: one arm with one seed, its envs, its checkpoints, and its trained policy."""

from ..processes import Progress
from .training import train_run

__all__ = ["Progress", "train_run"]
