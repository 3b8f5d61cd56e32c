"""Models of logged steps: affine by least squares, and an ensemble of neural networks (fitted with torch)."""

import itertools

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError


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


_MEMBERS, _HIDDEN, _BATCH, _UPDATES, _RATE = 5, 64, 256, 3000, 3e-3


class EnsembleModel:
    """The mean of networks of two hidden layers that predict the change of the state, all in normalised numbers.

    They differ in their first weights and in the batches that they were fitted to (Lakshminarayanan et al., *Simple
    and Scalable Predictive Uncertainty Estimation using Deep Ensembles*, 2017; of it only the mean).

    Args:
        states: Shape (k, n).
        controls: Shape (k, m).
        changes: Of the state over the step, shape (k, n).
        seed: Of first weights and batches.

    Raises:
        ConfigurationError: There is no torch.
    """

    def __init__(self, states: Array, controls: Array, changes: Array, seed: int) -> None:
        inputs = np.hstack([states, controls])
        self._mean, self._scale = inputs.mean(axis=0), _spread(inputs)
        self._change_mean, self._change_scale = changes.mean(axis=0), _spread(changes)
        self.layers: list[tuple[Array, Array]] = _fitted(
            (inputs - self._mean) / self._scale, (changes - self._change_mean) / self._change_scale, seed
        )
        """Weights, shape (members, in, out), and biases, shape (members, 1, out)."""

    def __call__(self, states: Array, controls: Array) -> Array:
        """The states after a step, shape (k, n), from states, shape (k, n), and controls, shape (k, m)."""
        values = (np.concatenate([states, controls], axis=1) - self._mean) / self._scale
        for weights, biases in self.layers[:-1]:
            values = np.tanh(values @ weights + biases)
        weights, biases = self.layers[-1]
        change = (values @ weights + biases).mean(axis=0)
        return np.asarray(states + self._change_mean + self._change_scale * change)


def _spread(numbers: Array) -> Array:
    """Standard deviations, 1 where a number never changes, shape (n,)."""
    found = numbers.std(axis=0)
    return np.where(found > 1e-12 * (1.0 + np.abs(numbers).max(axis=0)), found, 1.0)


def _fitted(inputs: Array, targets: Array, seed: int) -> list[tuple[Array, Array]]:
    """The layers after Adam with a falling step size; every member draws its own batches."""
    try:
        import torch
    except ImportError as error:
        raise ConfigurationError(
            'IdentifiedPlant(model="ensemble") is fitted with torch, which is not installed: '
            "pip install 'safe-wrappers[train]', or take model=\"linear\""
        ) from error
    draw = torch.Generator().manual_seed(seed)
    x, y = torch.as_tensor(inputs, dtype=torch.float32), torch.as_tensor(targets, dtype=torch.float32)
    sizes = [x.shape[1], _HIDDEN, _HIDDEN, y.shape[1]]
    layers = []
    for width, out in itertools.pairwise(sizes):
        weights = torch.randn(_MEMBERS, width, out, generator=draw) / width**0.5
        layers.append((weights.requires_grad_(), torch.zeros(_MEMBERS, 1, out, requires_grad=True)))
    optimizer = torch.optim.Adam([one for layer in layers for one in layer], lr=_RATE)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums have one order, so that a seed has one result
    try:
        for update in range(_UPDATES):
            optimizer.param_groups[0]["lr"] = _RATE * (1.0 - update / _UPDATES)
            chosen = torch.randint(len(x), (_MEMBERS, _BATCH), generator=draw)
            values = x[chosen]
            for weights, biases in layers[:-1]:
                values = torch.tanh(torch.baddbmm(biases, values, weights))
            weights, biases = layers[-1]
            loss = (torch.baddbmm(biases, values, weights) - y[chosen]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    finally:
        torch.set_num_threads(threads)
    return [
        (weights.detach().numpy().astype(np.float64), biases.detach().numpy().astype(np.float64))
        for weights, biases in layers
    ]
