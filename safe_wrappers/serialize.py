"""Constraints as plain data, so that a wrapper that holds them can be recorded, rebuilt and written as JSON."""

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

from safe_wrappers.constraints.backup.coasting_clearance import CoastingClearance
from safe_wrappers.constraints.backup.escape_clearance import EscapeClearance
from safe_wrappers.constraints.backup.heading_drive_clearance import HeadingDriveClearance
from safe_wrappers.constraints.backup.wall_clearance import WallClearance
from safe_wrappers.constraints.barrier import Barrier
from safe_wrappers.constraints.clearance import Clearance
from safe_wrappers.constraints.contact.contact_feasibility import ContactFeasibility
from safe_wrappers.constraints.contact.impact_speed_limit import ImpactSpeedLimit
from safe_wrappers.constraints.contact.stance import Stance
from safe_wrappers.constraints.contact.support_margin import SupportMargin
from safe_wrappers.constraints.limits.joint_position_limit import JointPositionLimit
from safe_wrappers.constraints.limits.joint_speed_limit import JointSpeedLimit
from safe_wrappers.constraints.limits.singularity_margin import SingularityMargin
from safe_wrappers.constraints.limits.speed_limit import SpeedLimit
from safe_wrappers.constraints.limits.upright import Upright
from safe_wrappers.constraints.limits.workspace import Workspace
from safe_wrappers.constraints.obstacles.obstacle_kinds import obstacle_data
from safe_wrappers.constraints.track_permission import TrackPermission
from safe_wrappers.constraints.traction import Traction
from safe_wrappers.errors import UnknownNameError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.duck_typed import duck_typed

KINDS: dict[str, Callable[..., Constraint]] = {
    "Barrier": Barrier,
    "Clearance": Clearance,
    "CoastingClearance": CoastingClearance,
    "ContactFeasibility": ContactFeasibility,
    "EscapeClearance": EscapeClearance,
    "HeadingDriveClearance": HeadingDriveClearance,
    "ImpactSpeedLimit": ImpactSpeedLimit,
    "JointPositionLimit": JointPositionLimit,
    "JointSpeedLimit": JointSpeedLimit,
    "SingularityMargin": SingularityMargin,
    "SpeedLimit": SpeedLimit,
    "Stance": Stance,
    "SupportMargin": SupportMargin,
    "TrackPermission": TrackPermission,
    "Traction": Traction,
    "Upright": Upright,
    "WallClearance": WallClearance,
    "Workspace": Workspace,
}


def constraint_from(data: Any) -> Constraint:
    """A constraint itself, or rebuilt from `constraint_data`."""
    if not isinstance(data, dict):
        return data if isinstance(data, Constraint) else duck_typed(data)
    kind = data.get("kind", "")
    if kind not in KINDS:
        raise UnknownNameError(f"unknown constraint kind {kind!r}; the kinds are {', '.join(KINDS)}")
    known = inspect.signature(KINDS[kind]).parameters
    for key in data:
        if key not in known and key != "kind":
            raise UnknownNameError(f"{kind} has no {key!r}; it has {', '.join(known)}")
    return KINDS[kind](**{k: v for k, v in data.items() if k != "kind"})


def constraint_data(constraint: Constraint) -> Any:
    """The plain dict of a constraint of ours; a foreign one, or one that holds functions, as it is."""
    name = type(constraint).__name__
    if KINDS.get(name) is not type(constraint) or isinstance(constraint, Barrier):
        return constraint
    assert is_dataclass(constraint)
    data: dict[str, Any] = {"kind": name}
    for field in fields(constraint):
        if field.init and field.name != "promise":
            value = getattr(constraint, field.name)
            obstacles = field.name in ("obstacles", "keep_out", "untouched")
            data[field.name] = [obstacle_data(o) for o in value] if obstacles else value
    return data
