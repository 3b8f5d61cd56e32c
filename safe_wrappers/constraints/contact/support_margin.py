"""SupportMargin: the zero moment point stays inside the support polygon, by an inset."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, non_negative, positive
from safe_wrappers.constraints.contact.contact_feasibility import require_contacts
from safe_wrappers.constraints.rollout import BoundSlacks
from safe_wrappers.control.legged.support import support_distances
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.plants.mujoco.contacts import ContactForecast
from safe_wrappers.plants.plant import Plant


@dataclass
class SupportMargin(Constraint):
    """Keep the zero moment point of the contact forces inside the hull of the contact points, by an inset.

    Without at least three contact points in one plane that are not on a line there is no polygon and no requirement.

    Best effort: an executed control that is not flagged keeps the inset at every evaluation of the physics of its
    control step at which there is a polygon, for a plant that is right. Such a control need not exist.

    Args:
        inset: m, positive: pushing forces alone keep the point inside the hull. An inset of millimetres can be
            crossed between two evaluations.
        margin: Kept free inside the inset, m.

    Source: appendix "Physical contact feasibility constraints", third condition and footnote 8.
    """

    inset: float
    margin: float = 0.0

    def __post_init__(self) -> None:
        self.inset = positive("inset", self.inset, "m: forces that push keep the point inside by themselves")
        self.margin = non_negative("margin", self.margin, "m")

    def bind(self, plant: Plant) -> "BoundSupportMargin":
        return BoundSupportMargin(self, plant)


class BoundSupportMargin(BoundSlacks):
    """SupportMargin on a plant."""

    info_keys: tuple[str, ...] = (keys.WHOLE_BODY_ZMP_MARGIN,)
    spec: SupportMargin

    def __init__(self, spec: SupportMargin, plant: Plant) -> None:
        super().__init__(spec, require_contacts(plant, "SupportMargin"))

    def observe(self, memory: Memory) -> None:
        self._known: list[tuple[ContactForecast, list[float]]] = []

    def _distances(self, found: ContactForecast) -> list[float]:
        """Of a forecast, computed once."""
        for other, distances in self._known:
            if other is found:
                return distances
        of = found.step, found.point, found.normal, found.force
        distances = [float(distance) for distance in support_distances(*of)]
        self._known.append((found, distances))
        return distances

    def slacks(self, control: Array) -> Array:
        """Distance to the edge minus inset and margin where it is least, shape (1,), m; 0 where there is none."""
        found = self.plant.contact_forecast(control)
        if not found.finite:
            return np.array([np.nan])
        left = (d - self.spec.inset - self.spec.margin for d in self._distances(found))
        return np.array([min(left, default=0.0)])

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        """The info key `whole_body/zmp_margin`: forecast for the executed control."""
        least = 0.0
        if executed is not None:
            found = self.plant.contact_forecast(executed)
            least = min(self._distances(found), default=0.0) if found.finite else 0.0
        return {keys.WHOLE_BODY_ZMP_MARGIN: least}
