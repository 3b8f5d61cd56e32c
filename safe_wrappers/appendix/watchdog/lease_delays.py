"""The delays from the reading of a clearance to full braking, in addition to the lease.

Source: appendix "Kinematic derivation of watchdog validity leases"; `safe_wrappers.control.watchdog.leases` takes
their sum.
"""

import math
from dataclasses import dataclass, fields

from safe_wrappers.errors import ConfigurationError


@dataclass(frozen=True)
class LeaseDelays:
    """Delays in addition to the lease, in s, finite and at least 0.

    Attributes:
        detect_s: T_detect, until the end of the lease is recognised.
        hold_s: T_hold, a confirmation window in which the last command continues.
        age_s: t_age, age of the clearance's reading when the lease is granted.
        act_s: T_act, until full deceleration.
    """

    detect_s: float = 0.0
    hold_s: float = 0.0
    age_s: float = 0.0
    act_s: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ConfigurationError(f"{field.name} must be a finite time of at least 0 s, got {value!r}")

    @property
    def total_s(self) -> float:
        """Their sum, s."""
        return self.detect_s + self.hold_s + self.age_s + self.act_s
