"""ContactFeasibility and SupportMargin: what the forces of the ground on the robot have to keep."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, check_fields, non_negative, positive
from safe_wrappers.constraints.rollout import BoundSlacks
from safe_wrappers.control.legged.support import support_distances
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.plants.mujoco.contacts import ContactForecast, can_touch_the_world
from safe_wrappers.plants.mujoco.model import weight_n
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant


@dataclass
class ContactFeasibility(Constraint):
    """Keep every contact force of the robot with the fixed world inside a narrower friction cone: `|f_t| <= mu f_n`.

    In a simulator all forces are inside the model's cone, and those on it slide: so the required cone is narrower.

    Best effort: an executed control that is not flagged keeps every contact force of its control step, at every
    evaluation of the physics, within cone and tolerance, for a plant that is right. Such a control need not exist: a
    foot that lands sideways slides. Balance is not promised.

    Args:
        friction_share: Of the model's friction coefficient, in (0, 1]. MuJoCo's default cones are pyramids: above
            0.71 a foot may slide within its share.
        tolerance: By how much a force may miss its cone, as a share of the robot's weight: light touches scrape.
        margin: Kept free inside the cone, as a share of the weight. More than the tolerance refuses light touches.

    Source: appendix "Physical contact feasibility constraints".
    """

    friction_share: float = 0.7
    tolerance: float = 0.01
    margin: float = 0.0

    def __post_init__(self) -> None:
        self.friction_share = checked_friction_share(self.friction_share)
        check_fields(self, non_negative, ("tolerance", "margin"), "shares of the weight")


class BoundContactFeasibility(BoundSlacks, of=ContactFeasibility):
    """ContactFeasibility on a plant."""

    info_keys: tuple[str, ...] = (keys.WHOLE_BODY_CONE_MARGIN,)
    spec: ContactFeasibility

    def __init__(self, spec: ContactFeasibility, plant: Plant) -> None:
        super().__init__(spec, require_contacts(plant, "ContactFeasibility"))
        self._chosen = np.flatnonzero(touching_bodies(self.plant, "there is no cone to stay in"))

    def insides(self, control: Array) -> Array:
        """By how much each body's contact forces stay inside the cone, at worst, shape (k,), shares of the weight.

        Infinite for a body that touches nothing; NaN where the simulation has diverged.
        """
        found = self.plant.contact_forecast(control)
        worst = np.full(self.plant.model.nbody, np.inf if found.finite else np.nan)
        along = np.einsum("ki,ki->k", found.force, found.normal)
        across = np.linalg.norm(found.force - along[:, None] * found.normal, axis=1)
        inside = np.minimum(along, self.spec.friction_share * found.friction * along - across)
        np.minimum.at(worst, found.body, inside / weight_n(self.plant.model))
        return worst[self._chosen]

    def slacks(self, control: Array) -> Array:
        """What is left of the cone, tolerance added and margin taken off, per body, shares of the weight."""
        # Capped at the margin: differences between a touch and none would say nothing of the touch.
        return np.minimum(self.insides(control), self.spec.margin) + self.spec.tolerance - self.spec.margin

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        """The info key `whole_body/cone_margin`: forecast for the executed control."""
        margin = 0.0 if executed is None else float(self.insides(executed).min())
        return {keys.WHOLE_BODY_CONE_MARGIN: margin if np.isfinite(margin) else 0.0}


def require_contacts(plant: Plant, asker: str) -> MujocoPlant:
    """The plant, if it can forecast contact forces."""
    hint = "forecasts contact forces with a MuJoCo model; an AnalyticPlant has none"
    return require_mujoco(plant, f"{asker} {hint}")


def checked_friction_share(share: float) -> float:
    """A share of the model's friction, in (0, 1]."""
    share = positive("friction_share", share, "shares of the model's friction")
    if share > 1.0:
        raise ConfigurationError(
            f"friction_share is in (0, 1], got {share}: no simulated ground holds more than its own friction; a "
            "model with more is MujocoPlant(model=...)"
        )
    return share


def touching_bodies(plant: MujocoPlant, lacking: str) -> NDArray[np.bool_]:
    """Which bodies can touch the fixed world, shape (nbody,); refuses a model that has none."""
    touching = can_touch_the_world(plant.model)
    if not touching.any():
        raise UnsupportedEnvError(f"no body of this model can touch the fixed world with friction: {lacking}")
    return touching


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


class BoundSupportMargin(BoundSlacks, of=SupportMargin):
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
