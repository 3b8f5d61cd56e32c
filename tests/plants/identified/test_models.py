"""Fitted dynamics: a linear system is found again."""

import numpy as np

from safe_wrappers.plants.identified import LinearModel


def test_a_linear_system_is_found_again():
    draw = np.random.default_rng(0)
    a, b, c = draw.normal(size=(4, 4)), draw.normal(size=(2, 4)), draw.normal(size=4)
    states, controls = draw.normal(size=(100, 4)) * [1.0, 100.0, 0.01, 1.0], draw.normal(size=(100, 2))
    after = states @ a + controls @ b + c
    model = LinearModel(states, controls, after - states)
    np.testing.assert_allclose(model.weights, np.vstack([a - np.eye(4), b, c]), atol=1e-9)
    new = draw.normal(size=(5, 4)), draw.normal(size=(5, 2))
    np.testing.assert_allclose(model(*new), new[0] @ a + new[1] @ b + c, atol=1e-9)
