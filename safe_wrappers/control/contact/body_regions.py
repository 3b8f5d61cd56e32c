"""What ISO/TS 15066 lets a robot do to each region of the body: permissible forces, and the body's spring and mass.

Source: ISO/TS 15066:2016, Annex A, Tables A.2 and A.3; ISO 10218-2:2025 has taken them over. **Written down from
memory and compared with secondary sources where there were any, not with the standard's text**: before a machine
meets a person, check every number against the edition that applies. The limits are of pain onset in healthy adults;
they leave out pressure (a sharp edge exceeds it far below these forces) and repeated contact.
"""

from dataclasses import dataclass

from safe_wrappers.errors import UnknownNameError


@dataclass(frozen=True, slots=True)
class BodyRegion:
    """One row of the tables.

    Attributes:
        quasi_static_force: Permissible force while clamped between the robot and something fixed, N.
        transient_force: Permissible peak force on a region free to recoil, N; None where contact is not foreseen.
        stiffness: Spring constant, N/m (the standard's is in N/mm).
        mass: Effective mass, kg.
    """

    quasi_static_force: float
    transient_force: float | None
    stiffness: float
    mass: float


BODY_REGIONS: dict[str, BodyRegion] = {
    "skull and forehead": BodyRegion(130.0, None, 150e3, 4.4),
    "face": BodyRegion(65.0, None, 75e3, 4.4),
    "neck": BodyRegion(150.0, 300.0, 50e3, 1.2),
    "back and shoulders": BodyRegion(210.0, 420.0, 35e3, 40.0),
    "chest": BodyRegion(140.0, 280.0, 25e3, 40.0),
    "abdomen": BodyRegion(110.0, 220.0, 10e3, 40.0),
    "pelvis": BodyRegion(180.0, 360.0, 25e3, 40.0),
    "upper arms and elbow joints": BodyRegion(150.0, 300.0, 30e3, 3.0),
    "lower arms and wrist joints": BodyRegion(160.0, 320.0, 40e3, 2.0),
    "hands and fingers": BodyRegion(140.0, 280.0, 75e3, 0.6),
    "thighs and knees": BodyRegion(220.0, 440.0, 50e3, 75.0),
    "lower legs": BodyRegion(130.0, 260.0, 60e3, 75.0),
}
"""By the names of Table A.3."""


def body_region(name: str) -> BodyRegion:
    """The row of a region.

    Raises:
        UnknownNameError: No region of that name.
    """
    if name not in BODY_REGIONS:
        raise UnknownNameError(f"no body region {name!r}; choose {', '.join(BODY_REGIONS)}")
    return BODY_REGIONS[name]
