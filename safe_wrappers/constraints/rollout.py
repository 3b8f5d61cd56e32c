"""RolloutConstraint: the base of limits that are judged on a MuJoCo model's trajectories."""

from typing import ClassVar

from safe_wrappers.errors import check_fields, non_negative, positive, whole_number
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Plant


class RolloutConstraint(Constraint):
    """A requirement along a trajectory of the held control, and then of the actuated joints braking.

    A subclass is a dataclass with the fields `margin` (in `unit`), `horizon` (control intervals to look ahead) and
    `max_decrease` (in `unit`, or None: every control is forecast).
    """

    unit: ClassVar[str] = "units of h"

    def _check_shared(self) -> None:
        self.margin = non_negative("margin", self.margin, self.unit)
        self.horizon = whole_number("horizon", self.horizon, 1, "control intervals to look ahead")
        check_fields(self, positive, ("max_decrease",), self.unit)

    def setup(self, plant: Plant) -> None:
        hint = "forecasts with a MuJoCo model; on an AnalyticPlant use Barrier(h), beside a shield its h"
        super().setup(require_mujoco(plant, f"{type(self).__name__} {hint}"))
