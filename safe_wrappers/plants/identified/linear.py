"""Linear dynamics, fitted by least squares."""

import numpy as np

from safe_wrappers.checks import Array


class LinearModel:
    """`x+ = x + [x, u, 1] @ weights`: affine in state and control.

    Args:
        states: Shape (k, n).
        controls: Shape (k, m).
        changes: Of the state over the step, shape (k, n).

    Attributes:
        weights: Shape (n + m + 1, n). Of many that fit equally well, the smallest.
    """

    def __init__(self, states: Array, controls: Array, changes: Array) -> None:
        inputs = np.hstack([states, controls, np.ones((len(states), 1))])
        self.weights: Array = np.asarray(np.linalg.lstsq(inputs, changes, rcond=None)[0], dtype=np.float64)

    def __call__(self, states: Array, controls: Array) -> Array:
        """The states after a step, shape (k, n), from states, shape (k, n), and controls, shape (k, m)."""
        n, m = states.shape[1], controls.shape[1]
        change = states @ self.weights[:n] + controls @ self.weights[n : n + m] + self.weights[-1]
        return np.asarray(states + change)
