"""What goes wrong between a policy and a robot, as seeded wrappers: to test with, and to train against."""

from safe_wrappers.wrappers.faults.fault import Fault
from safe_wrappers.wrappers.faults.kinds import (
    ClockSkew,
    DroppedRefreshes,
    FrozenPolicy,
    Jitter,
    Outages,
    RepeatedCommands,
)

FAULTS: dict[str, type[Fault]] = {
    kind.__name__: kind
    for kind in (ClockSkew, DroppedRefreshes, FrozenPolicy, Jitter, Outages, RepeatedCommands)
}
"""By name, for configs."""

__all__ = [
    "FAULTS",
    "ClockSkew",
    "DroppedRefreshes",
    "Fault",
    "FrozenPolicy",
    "Jitter",
    "Outages",
    "RepeatedCommands",
]
