"""Fitted dynamics: a linear system is found again."""

import numpy as np

import safe_wrappers as sw


def test_a_linear_system_is_found_again():
    draw = np.random.default_rng(0)
    a, b, c = 0.1 * draw.normal(size=(4, 4)), draw.normal(size=(2, 4)), draw.normal(size=4)
    episodes = []
    for _ in range(20):
        controls = draw.normal(size=(10, 2)) * [1.0, 100.0]
        states = [draw.normal(size=4) * [1.0, 100.0, 0.01, 1.0]]
        for control in controls:
            states.append(states[-1] @ a + control @ b + c)
        episodes.append((np.array(states), controls))
    model = sw.IdentifiedPlant(episodes).model
    new = draw.normal(size=(5, 4)), draw.normal(size=(5, 2))
    np.testing.assert_allclose(model(*new), new[0] @ a + new[1] @ b + c, atol=1e-9)
