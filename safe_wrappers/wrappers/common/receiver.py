"""CommandReceiver: a wrapper that must know how old a command is, not only what it says."""

from abc import ABC, abstractmethod
from typing import Any

import gymnasium as gym

from safe_wrappers.plants.plant import wrappers_of


class CommandReceiver(ABC):
    """What `ChunkHandover` and `LeaseExpiry` have in common: they are told what the next action is made from.

    An action of Gymnasium says nothing of its age: a frozen policy that repeats itself looks alive. So whoever
    carries actions (a fault, a queue, a network) may `deliver` a stamp before `step`; without a word the action is
    made from the newest observation.
    """

    @property
    @abstractmethod
    def now_s(self) -> float:
        """Seconds of the episode so far, on the clock of control steps."""

    @abstractmethod
    def deliver(self, observed_s: float | None) -> None:
        """Say what the next action is made from.

        Args:
            observed_s: When its observation was made, s on the clock of `now_s`; None: nothing arrives, and the
                next step's action is disregarded.
        """


def receiver_inside(env: gym.Env[Any, Any]) -> CommandReceiver | None:
    """The outermost receiver of an env's wrappers."""
    return next((inner for inner in wrappers_of(env) if isinstance(inner, CommandReceiver)), None)
