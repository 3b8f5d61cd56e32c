"""The body's regions: what the tables say of each other, and the speed they allow, by hand."""

import numpy as np
import pytest

from safe_wrappers.control.contact.body_regions import BODY_REGIONS, body_region
from safe_wrappers.control.contact.impact import reduced_mass, speed_limit
from safe_wrappers.errors import UnknownNameError


def test_transient_limits_are_twice_the_quasi_static_ones_where_contact_is_foreseen():
    assert len(BODY_REGIONS) == 12
    for name, region in BODY_REGIONS.items():
        if name in ("skull and forehead", "face"):
            assert region.transient_force is None
        else:
            assert region.transient_force == 2.0 * region.quasi_static_force
        assert 65.0 <= region.quasi_static_force <= 220.0
        assert 10e3 <= region.stiffness <= 150e3  # N/m, not N/mm
        assert 0.6 <= region.mass <= 75.0


def test_a_chest_and_a_robot_of_ten_kilograms_by_hand():
    chest = body_region("chest")
    assert (chest.quasi_static_force, chest.transient_force, chest.stiffness, chest.mass) == (
        140,
        280,
        25e3,
        40,
    )
    speed = speed_limit(chest.transient_force, reduced_mass(10.0, chest.mass), chest.stiffness)
    assert speed == pytest.approx(280.0 / np.sqrt(25e3 * 8.0))  # 1 / (1/10 + 1/40) = 8 kg


def test_an_unknown_region_is_refused_with_the_list():
    with pytest.raises(
        UnknownNameError, match=r"no body region 'torso'; choose skull and forehead, face, neck, .*legs"
    ):
        body_region("torso")
