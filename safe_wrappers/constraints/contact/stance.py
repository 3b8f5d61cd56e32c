"""Stance: the whole-body program as a constraint on torques."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import non_negative, positive, whole_number
from safe_wrappers.constraints.limits.joints import refuse_uncovered_stops, stops
from safe_wrappers.control.contact.friction_cone import cone_excess
from safe_wrappers.control.legged.predicted_positions import predicted_position_rows
from safe_wrappers.control.legged.support import common_plane, support_polygon, support_rows
from safe_wrappers.control.legged.whole_body import (
    WholeBodyProblem,
    WholeBodySolution,
    WholeBodyStatus,
    attainable_contact_acceleration,
    rigid_forces,
    solve_cone,
    solve_pyramid,
)
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.constraint import BoundConstraint, Constraint, Memory, Promise
from safe_wrappers.plants.mujoco.contacts import can_touch_the_world
from safe_wrappers.plants.mujoco.model import fixed_bodies
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.queries.floating_base import equations_of_motion

Array = NDArray[np.float64]

_SAME = 1e-9
"""Distance from the program's answer that is rounding, control units."""


@dataclass
class Stance(Constraint):
    """Keep to torques under which standing feet could stay: the whole-body program at one instant.

    The contacts with the fixed world that carry force under the policy's torques are to come to rest and stay; those
    that carry none open. A control is admitted if forces inside the narrowed friction cones can hold the former, with
    the driven joints predicted to stay in range at a constant acceleration until the control step ends. Else the
    closest such control is the answer of a quadratic program (pyramids) or of a second-order cone program.

    What it promises: at this instant, for rigid contacts and a plant that is right, such forces exist. Landing feet,
    soft contacts and changes of the configuration within the control step are not in it (`ContactFeasibility`
    forecasts them). Where no control is admitted the step is infeasible. Hence best effort.

    Args:
        friction_share: Of the model's friction coefficient, in (0, 1].
        cone: "pyramid" is conservative and quick, "exact" is the cone itself.
        edges: Of the pyramid, >= 3.
        joint_tolerance: How far driven joints may press their stops, rad or m; None leaves them alone.
        zmp_inset: Distance of the zero moment point from the edge of the support polygon, m, where there is one.
        settle_s: Time constant in which what still moves at a contact is to come to rest, s.

    Source: appendix "Hierarchical whole-body control quadratic program".
    """

    friction_share: float = 0.7
    cone: Literal["pyramid", "exact"] = "pyramid"
    edges: int = 8
    joint_tolerance: float | None = 0.1
    zmp_inset: float | None = None
    settle_s: float = 0.05

    promise: Promise = field(default="best effort", init=False)

    def __post_init__(self) -> None:
        self.friction_share = positive(
            "friction_share", self.friction_share, "shares of the model's friction"
        )
        if self.friction_share > 1.0:
            raise ConfigurationError(f"friction_share is in (0, 1], got {self.friction_share}")
        if self.cone not in ("pyramid", "exact"):
            raise ConfigurationError(f'cone is "pyramid" or "exact", got {self.cone!r}')
        self.edges = whole_number("edges", self.edges, 3)
        if self.joint_tolerance is not None:
            self.joint_tolerance = non_negative("joint_tolerance", self.joint_tolerance, "rad or m")
        if self.zmp_inset is not None:
            self.zmp_inset = positive("zmp_inset", self.zmp_inset, "m: forces that push do the rest")
        self.settle_s = positive("settle_s", self.settle_s, "s")

    def bind(self, plant: Plant) -> "BoundStance":
        """On a plant."""
        return BoundStance(self, plant)


class BoundStance(BoundConstraint):
    """Stance on a plant."""

    predicts: bool = True
    info_keys: tuple[str, ...] = (keys.WHOLE_BODY_CONTACTS, keys.WHOLE_BODY_CONE_MARGIN)
    spec: Stance
    plant: MujocoPlant

    def __init__(self, spec: Stance, plant: Plant) -> None:
        hint = "Stance reads inertia and contacts from a MujocoPlant whose controls are forces"
        super().__init__(spec, require_mujoco(plant, hint))
        if not plant.has_acceleration:
            raise UnsupportedEnvError(hint)
        if not can_touch_the_world(self.plant.model).any():
            raise UnsupportedEnvError(
                "no body of this model can touch the fixed world with friction: there is nothing to stand on"
            )
        if self.spec.joint_tolerance is not None:
            refuse_uncovered_stops(self.plant.model)
        self._joints, low, high = stops(self.plant.model)
        wider = self.spec.joint_tolerance or 0.0
        self._low, self._high = low - wider, high + wider
        self._qpos = self.plant.model.jnt_qposadr[self._joints]
        self._dofs = self.plant.model.jnt_dofadr[self._joints]

    def observe(self, memory: Memory) -> None:
        """Nothing is known of this state yet."""
        self._known = False
        self._problem: WholeBodyProblem | None = None
        self._answer: WholeBodySolution | None = None
        self._asked: Array | None = None
        self._contacts = 0

    def _write_down(self, control: Array) -> None:
        """The program, once per observation; the first control asked for says which contacts open."""
        if self._known:
            return
        self._known = True
        data = self.plant.under(control)
        motion = equations_of_motion(self.plant.model, data, self.plant.actuators)
        found = motion.contacts
        # Beyond this MuJoCo resets the state in its step.
        within = bool((np.abs(self.plant.state) < mujoco.mjMAXVAL).all())
        if not (within and np.isfinite(motion.bias).all() and np.isfinite(found.forces).all()):
            return  # nothing can be said
        ground = fixed_bodies(self.plant.model)[found.pushed_by]
        # What the robot's bodies do to each other, and other things to it, stays as it is.
        bias = motion.bias - np.einsum("kiv,ki->v", found.jacobians[~ground], found.forces[~ground])
        jacobians, drift, normals = found.jacobians[ground], found.drift[ground], found.normals[ground]
        pressing = np.einsum("ki,ki->k", found.forces[ground], normals) > 0.0
        acceleration = -(jacobians @ self.plant.qvel) / self.spec.settle_s
        limits: dict[str, Any] = {}
        if self.spec.joint_tolerance is not None:
            limits["acceleration_rows"], limits["acceleration_limits"] = predicted_position_rows(
                self._dofs,
                self.plant.qpos[self._qpos],
                self.plant.qvel[self._dofs],
                self._low,
                self._high,
                self.plant.control_dt,
                self.plant.model.nv,
            )
        if self.spec.zmp_inset is not None:
            rows = self._balance(found.points[ground], normals, pressing)
            if rows is not None:
                limits["force_rows"], limits["force_limits"] = rows, np.zeros(len(rows))
        problem = WholeBodyProblem(
            motion.inertia,
            bias,
            motion.actuation,
            jacobians,
            drift,
            normals,
            self.spec.friction_share * found.friction[ground],
            self.plant.lower,
            self.plant.upper,
            control,
            contact_acceleration=acceleration,
            breaking=~pressing,
            first_tangents=found.first_tangents[ground],
            **limits,
        )
        # Two points of one rigid foot cannot come to rest each as it likes.
        self._problem = replace(problem, contact_acceleration=attainable_contact_acceleration(problem))
        self._contacts = int(ground.sum())

    def _balance(self, points: Array, normals: Array, pressing: NDArray[np.bool_]) -> Array | None:
        """The inset, as rows on all contact forces; None where there is no polygon."""
        assert self.spec.zmp_inset is not None
        if np.count_nonzero(pressing) < 3:
            return None
        plane = common_plane(points[pressing], normals[pressing])
        if plane is None or len(support_polygon(plane.flat(points[pressing]))) < 3:
            return None
        some = support_rows(points[pressing], plane, self.spec.zmp_inset)
        rows = np.zeros((len(some), len(points), 3))
        rows[:, pressing] = some.reshape(len(some), -1, 3)
        return np.asarray(rows.reshape(len(some), -1))

    def _solve(self, problem: WholeBodyProblem) -> WholeBodySolution:
        return solve_cone(problem) if self.spec.cone == "exact" else solve_pyramid(problem, self.spec.edges)

    def admits(self, control: Array) -> bool:
        """Whether the standing contacts could answer this control with forces inside their cones."""
        # An action space of another precision than the model's range may be a rounding wider.
        control = np.clip(control, self.plant.lower, self.plant.upper)
        self._write_down(control)
        if self._problem is None:
            return False
        answer = self._answer
        if answer is None or self._asked is None:
            answer = self._ask(self._problem, control)
        if self._asked is not None and np.array_equal(control, self._asked):
            return answer.status is WholeBodyStatus.INACTIVE
        if answer.status is WholeBodyStatus.INFEASIBLE:
            return False  # whatever the control
        if float(np.abs(control - answer.control).max()) <= _SAME:
            return answer.status is not WholeBodyStatus.FAILED
        return self._solve(replace(self._problem, nominal=control)).status is WholeBodyStatus.INACTIVE

    def _ask(self, problem: WholeBodyProblem, proposed: Array) -> WholeBodySolution:
        """Solve for a proposal, and keep the answer."""
        self._asked, self._answer = proposed.copy(), self._solve(replace(problem, nominal=proposed))
        return self._answer

    def candidates(self, proposed: Array) -> Iterator[Array]:
        """The program's answer; where there is none, the control that misses least, which is refused."""
        proposed = np.clip(proposed, self.plant.lower, self.plant.upper)
        self._write_down(proposed)
        if self._problem is None:
            return
        if self._answer is None:  # another constraint was asked first, and has refused
            self._ask(self._problem, proposed)
        assert self._answer is not None
        yield self._answer.control

    def slack(self, control: Array) -> float:
        """What the forces that would hold the contacts leave of their cones, shares of the weight."""
        control = np.clip(control, self.plant.lower, self.plant.upper)
        self._write_down(control)
        if self._problem is None:
            return -np.inf
        forces, _ = rigid_forces(self._problem, control)
        if not len(forces):
            return 0.0
        missed = cone_excess(forces, self._problem.normals, self._problem.friction)
        return -float(missed.max()) / self.plant.weight_n

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        """The info keys `whole_body/contacts` and `whole_body/cone_margin`: of the forces that would hold them."""
        contacts, margin = 0, 0.0
        if executed is not None and self._problem is not None:
            contacts, margin = self._contacts, 0.0 + self.slack(executed)
        return {keys.WHOLE_BODY_CONTACTS: contacts, keys.WHOLE_BODY_CONE_MARGIN: margin}
