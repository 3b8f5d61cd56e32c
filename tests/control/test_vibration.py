"""Modes against scipy's eigenvalues."""

import numpy as np
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_wrappers.control.bandwidth import modes


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_modes_are_scipys_and_light_damping_moves_its_eigenvalues_as_they_say(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    roots = rng.normal(size=(3, n, n))
    inertia = roots[0] @ roots[0].T + 0.3 * np.eye(n)
    stiffness = roots[1] @ np.diag(np.r_[0.0, rng.uniform(50, 900, n - 1)]) @ roots[1].T  # one rigid motion
    damping = 1e-4 * roots[2] @ roots[2].T
    found = modes(inertia, stiffness, damping)
    squares = np.sort(scipy.linalg.eigh(stiffness, inertia, eigvals_only=True))
    np.testing.assert_allclose(found.resonances**2, squares, rtol=1e-6, atol=1e-6 * squares[-1])
    assert found.resonances[0] == found.damping_ratios[0] == 0.0
    np.testing.assert_allclose(found.shapes.T @ inertia @ found.shapes, np.eye(n), atol=1e-7)
    system = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(inertia, np.hstack([stiffness, damping]))]]
    )
    values = np.linalg.eigvals(system)
    ringing = values[values.imag > 1e-3]
    ringing = ringing[np.argsort(np.abs(ringing))]
    np.testing.assert_allclose(found.resonances[1:], np.abs(ringing), rtol=1e-4)
    np.testing.assert_allclose(
        found.damping_ratios[1:], -ringing.real / np.abs(ringing), rtol=1e-2, atol=1e-9
    )
