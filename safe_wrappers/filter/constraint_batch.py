"""ConstraintBatch: one constraint in many envs, observed and decided in one call."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.filter.constraint import Memory


class ConstraintBatch(ABC):
    """The bound constraints of n envs with one action box; `BoundConstraint.batch` makes it.

    It gives the same controls, bit for bit, as the constraints one by one.
    """

    @abstractmethod
    def restart(self, env: int, memory: Memory) -> None:
        """Take an env's new episode, or the memory that its own constraint was left with."""

    @abstractmethod
    def memory(self, env: int) -> Memory:
        """What the constraint of an env remembers, as its own `start` and `executed` give it."""

    @abstractmethod
    def decide(
        self, proposals: Array, judged: NDArray[np.bool_], controls: Array
    ) -> tuple[Array, NDArray[np.int64]]:
        """Take every env's present state and decide.

        Args:
            proposals: Inside the action box, shape (n, m); rows with NaN get an arbitrary answer.
            judged: Which envs to decide, shape (n,).
            controls: Written for those: what to execute, exact in the action space's dtype, shape (n, m). An admitted
                proposal is written as it is.

        Returns:
            The smallest h of each, shape (n,), NaN if one is not a number; and the `Stage` that found each control,
            shape (n,). Stage.FALLBACK: none was found, decide this env by its own constraint.
        """

    @abstractmethod
    def executed(self, envs: NDArray[np.bool_]) -> None:
        """Remember that the decisions for these envs, shape (n,), are executed; they are among those decided."""
