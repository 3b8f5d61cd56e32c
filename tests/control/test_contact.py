"""Complementarity, and the mass that a contact feels."""

import numpy as np
import pytest

from safe_wrappers.control.contact.contact import complementarity_residuals
from safe_wrappers.control.contact.impact import effective_mass
from safe_wrappers.errors import ConfigurationError


def test_residuals_are_zero_for_ideal_contacts_and_name_what_is_missed():
    ideal = complementarity_residuals([0.3, 0.0, 0.0], [0.0, 0.0, 50.0])
    assert all((r == 0.0).all() for r in ideal)
    missed = complementarity_residuals([-0.002, 0.1, 0.0], [40.0, 5.0, -3.0])
    assert missed.penetration.tolist() == [0.002, 0.0, 0.0]
    assert missed.tension.tolist() == [0.0, 0.0, 3.0]
    np.testing.assert_allclose(missed.product, [0.08, 0.5, 0.0])


def test_a_rod_that_lands_on_one_end_is_lighter_there():
    # Rod of mass m and length l at angle a: the end's normal velocity is y' - l/2 cos(a) w.
    m, length, angle = 3.0, 0.8, 0.4
    inertia, row = np.diag([m, m * length**2 / 12.0]), np.array([1.0, -0.5 * length * np.cos(angle)])
    assert effective_mass(inertia, row) == pytest.approx(m / (1.0 + 3.0 * np.cos(angle) ** 2))


def test_bad_input_is_refused_in_words():
    with pytest.raises(ConfigurationError, match="gap must be finite"):
        complementarity_residuals(np.nan, 1.0)
