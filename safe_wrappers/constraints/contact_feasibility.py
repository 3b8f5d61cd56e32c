"""ContactFeasibility, SupportMargin and Stance: what the forces between ground and robot have to keep."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control import whole_body
from safe_wrappers.control.contact import cone_excess
from safe_wrappers.control.legged import support_distances
from safe_wrappers.control.projection import Status
from safe_wrappers.control.whole_body import WholeBodyProblem, WholeBodySolution
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnsupportedEnvError,
    non_negative,
    positive,
)
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.plants.mujoco.binding import refuse_mapped
from safe_wrappers.plants.mujoco.contacts import Contacts, can_touch_the_world
from safe_wrappers.plants.mujoco.dynamics import equations_of_motion
from safe_wrappers.plants.mujoco.model import fixed_bodies, weight_n
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Model, Plant, Trajectory

_EDGES = 8  # of the pyramids inside the friction cones
_SETTLE_S = 0.05  # time constant in which what still moves at a contact is to come to rest, s
_SAME = 1e-7  # distance from the program's answer that is the rounding of an action, control units
_REFUSED = 1e-6  # by how much a control that no forces can hold misses at least, shares of the weight


class _ContactConstraint(Constraint, Model):
    """Of the contacts with the fixed world while a control is held for one control interval; `info_keys` is one."""

    measures_state: ClassVar[bool] = False

    def setup(self, plant: Plant) -> None:
        hint = "forecasts contact forces with a MuJoCo model; an AnalyticPlant has none"
        super().setup(require_mujoco(plant, f"{type(self).__name__} {hint}"))
        self.report = dict.fromkeys(self.info_keys, 0.0)

    def rollout(self, control: Array | None, horizon: int = 1) -> Contacts | None:
        """The forecast; None of the present state, of which nothing is known."""
        return None if control is None else self.plant.contact_forecast(control)


@dataclass
class ContactFeasibility(_ContactConstraint):
    """Keep every contact force of the robot with the fixed world inside a narrower friction cone: `|f_t| <= mu f_n`.

    In a simulator all forces are inside the model's cone, and those on it slide: so the required cone is narrower.

    Best effort: an executed control that is not flagged keeps every contact force of its control step, at every
    evaluation of the physics, within cone and tolerance, for a plant that is right. Such a control need not exist: a
    foot that lands sideways slides. Balance is not promised.

    Args:
        friction_share: Of the model's friction coefficient, in (0, 1]. MuJoCo's default cones are pyramids: above
            0.71 a foot may slide within its share.
        tolerance: By how much a force may miss its cone, as a share of the robot's weight: light touches scrape.

    Source: appendix "Physical contact feasibility constraints".
    """

    friction_share: float = 0.7
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        self.friction_share = checked_friction_share(self.friction_share)
        self.tolerance = non_negative("tolerance", self.tolerance, "shares of the weight")

    info_keys: ClassVar[tuple[str, ...]] = (keys.WHOLE_BODY_CONE_MARGIN,)

    def setup(self, plant: Plant) -> None:
        super().setup(plant)
        self._chosen = np.flatnonzero(touching_bodies(self.plant, "there is no cone to stay in"))

    def h_along(self, path: Contacts | None) -> Array:
        """By how much each body's contact forces stay inside the cone, tolerance added, shares of the weight.

        At most the tolerance: differences between a touch and none would say nothing of the touch. NaN where the
        simulation has diverged.
        """
        if path is None:
            return np.zeros((1, 0))
        worst = np.full(self.plant.model.nbody, np.inf if path.finite else np.nan)
        along = np.einsum("ki,ki->k", path.force, path.normal)
        across = np.linalg.norm(path.force - along[:, None] * path.normal, axis=1)
        inside = np.minimum(along, self.friction_share * path.friction * along - across)
        np.minimum.at(worst, path.body, inside / weight_n(self.plant.model))
        worst, least = worst[self._chosen], float(worst[self._chosen].min())
        self.report[keys.WHOLE_BODY_CONE_MARGIN] = least if np.isfinite(least) else 0.0
        return (np.minimum(worst, 0.0) + self.tolerance)[None]


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
class SupportMargin(_ContactConstraint):
    """Keep the zero moment point of the contact forces inside the hull of the contact points, by an inset.

    Without at least three contact points in one plane that are not on a line there is no polygon and no requirement.

    Best effort: an executed control that is not flagged keeps the inset at every evaluation of the physics of its
    control step at which there is a polygon, for a plant that is right. Such a control need not exist.

    Args:
        inset: m, positive: pushing forces alone keep the point inside the hull. An inset of millimetres can be
            crossed between two evaluations.

    Source: appendix "Physical contact feasibility constraints", third condition and footnote 8.
    """

    inset: float

    def __post_init__(self) -> None:
        self.inset = positive("inset", self.inset, "m: forces that push keep the point inside by themselves")

    info_keys: ClassVar[tuple[str, ...]] = (keys.WHOLE_BODY_ZMP_MARGIN,)

    def h_along(self, path: Contacts | None) -> Array:
        """Distance to the edge minus the inset where it is least, m; 0 where there is no polygon."""
        if path is None:
            return np.zeros((1, 0))
        if not path.finite:
            self.report[keys.WHOLE_BODY_ZMP_MARGIN] = 0.0
            return np.array([[np.nan]])
        distances = support_distances(path.step, path.point, path.normal, path.force)
        self.report[keys.WHOLE_BODY_ZMP_MARGIN] = least = float(min(distances, default=0.0))
        return np.array([[least - self.inset if len(distances) else 0.0]])


@dataclass
class Stance(Constraint, Model):
    """Keep to torques under which standing feet could stay: the whole-body program at one instant.

    Contacts with the fixed world that carry force under the policy's torques are to come to rest and stay; the others
    open. A control is admitted if forces inside the narrowed friction cones can hold them.

    Best effort: at this instant, for rigid contacts and a plant that is right, such forces exist. Changes within the
    control step are not in it (`ContactFeasibility` forecasts them).

    Args:
        friction_share: Of the model's friction coefficient, in (0, 1].
        cone: "pyramid" is conservative and quick, "exact" is the cone itself.

    Source: appendix "Hierarchical whole-body control quadratic program".
    """

    friction_share: float = 0.7
    cone: Literal["pyramid", "exact"] = "pyramid"

    def __post_init__(self) -> None:
        self.friction_share = checked_friction_share(self.friction_share)
        if self.cone not in ("pyramid", "exact"):
            raise ConfigurationError(f'cone is "pyramid" or "exact", got {self.cone!r}')

    info_keys: ClassVar[tuple[str, ...]] = (keys.WHOLE_BODY_CONE_MARGIN,)
    measures_state: ClassVar[bool] = False
    smooth: ClassVar[bool] = False

    def setup(self, plant: Plant) -> None:
        hint = "Stance reads inertia and contacts from a MujocoPlant whose controls are forces"
        super().setup(require_mujoco(plant, hint))
        if not plant.has_acceleration:
            raise UnsupportedEnvError(hint)
        refuse_mapped(self.plant.action_map, "Stance")
        touching_bodies(self.plant, "there is nothing to stand on")
        self.report = {keys.WHOLE_BODY_CONE_MARGIN: 0.0}

    def observe(self, memory: Memory) -> None:
        self._known = False
        self._problem: WholeBodyProblem | None = None
        self._answers: dict[bytes, WholeBodySolution] = {}

    def problem(self, control: Array) -> WholeBodyProblem | None:
        """The observed state's program; the first control, shape (m,), says which contacts open. None: not finite."""
        if not self._known:
            self._known, self._problem = True, self._write_down(control)
        return self._problem

    def _write_down(self, control: Array) -> WholeBodyProblem | None:
        plant = self.plant
        motion = equations_of_motion(plant.model, plant.under(control), plant.actuators)
        found = motion.contacts
        # Beyond this MuJoCo resets the state in its step.
        within = bool((np.abs(plant.state) < mujoco.mjMAXVAL).all())
        if not (within and np.isfinite(motion.bias).all() and np.isfinite(found.force).all()):
            return None  # nothing can be said
        ground = fixed_bodies(plant.model)[found.bodies[:, 0]]
        # What the robot's bodies do to each other, and other things to it, stays as it is.
        bias = motion.bias - np.einsum("kiv,ki->v", motion.jacobians[~ground], found.force[~ground])
        jacobians, drift, normals = motion.jacobians[ground], motion.drift[ground], found.normal[ground]
        pressing = np.einsum("ki,ki->k", found.force[ground], normals) > 0.0
        problem = WholeBodyProblem(
            *(motion.inertia, bias, motion.actuation, jacobians, drift, normals),
            *(self.friction_share * found.friction[ground], plant.lower, plant.upper, control),
            contact_acceleration=-(jacobians @ plant.qvel) / _SETTLE_S,
            breaking=~pressing,
        )
        # Two points of one rigid foot cannot come to rest each as it likes.
        attainable = whole_body.attainable_contact_acceleration(problem)
        return replace(problem, contact_acceleration=attainable)

    def _solved(self, problem: WholeBodyProblem, control: Array) -> WholeBodySolution:
        key = control.tobytes()
        if key not in self._answers:
            asked, exact = replace(problem, nominal=control), self.cone == "exact"
            answer = whole_body.solve_cone(asked) if exact else whole_body.solve_pyramid(asked, _EDGES)
            self._answers[key] = answer
        return self._answers[key]

    def _holds(self, problem: WholeBodyProblem, control: Array) -> bool:
        """Whether the standing contacts could answer this control with forces inside their cones."""
        for answer in self._answers.values():
            if answer.status is Status.INFEASIBLE:
                return False  # whatever the control
            if answer.status is Status.PROJECTED and np.abs(control - answer.control).max() <= _SAME:
                return True  # asked again it would move on, as forces have a price
        return self._solved(problem, control).status is Status.INACTIVE

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        """The present instant, under the control."""
        return Trajectory(control, self.plant.state[None])

    def h_along(self, path: Trajectory) -> Array:
        """What the forces that would hold the contacts leave of their cones, shares of the weight."""
        if path.control is None:
            return np.zeros((1, 0))
        # An action space of another precision than the model's range may be a rounding wider.
        control = np.clip(path.control, self.plant.lower, self.plant.upper)
        problem = self.problem(control)
        if problem is None:
            return np.array([[-np.inf]])
        forces = whole_body.rigid_forces(problem, control)
        missed = cone_excess(forces, problem.normals, problem.friction)
        left = -float(missed.max()) / weight_n(self.plant.model) if len(forces) else 0.0
        self.report[keys.WHOLE_BODY_CONE_MARGIN] = left
        return np.array([[max(left, 0.0) if self._holds(problem, control) else min(left, -_REFUSED)]])

    def proposals(self, control: Array | None) -> Iterator[Array]:
        """The program's answer; where there is none, the proposed control, which is refused."""
        if control is None:
            return
        proposed = np.clip(control, self.plant.lower, self.plant.upper)
        problem = self.problem(proposed)
        if problem is not None:
            yield self._solved(problem, proposed).control
