"""WholeBodyFilter: the closest torques to the policy's with contacts, joints and actuators in bounds."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import mujoco

from safe_wrappers.checks import non_negative
from safe_wrappers.constraints.contact.contact_feasibility import ContactFeasibility
from safe_wrappers.constraints.contact.stance import Stance
from safe_wrappers.constraints.contact.support_margin import SupportMargin
from safe_wrappers.constraints.limits.joint_position_limit import JointPositionLimit
from safe_wrappers.constraints.limits.joints import refuse_uncovered_stops, stops
from safe_wrappers.deprecation import deprecated_parameters
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.default import PlantTemplate, own_plant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter

TOLERANCE = 0.01
"""By how much a contact force may miss its cone unless told otherwise, as a share of the robot's weight."""
HOLDS = 3
"""Control steps to look ahead for the joints unless told otherwise."""


@deprecated_parameters(renamed={"holds": "horizon"})
class WholeBodyFilter(CBFActionFilter):
    """Keeps a legged robot's contact forces inside their friction cones and its joints off their stops.

    The executed torques are close to the policy's, inside the actuators' range, and such that contact forces and
    predicted joint positions are in bounds. What "contact forces" means is a choice:

    - ``contacts="forecast"``: those that the plant's simulation gives, at every evaluation of the physics of the
      whole control step, touch-downs included: `ContactFeasibility`, `JointPositionLimit` with braking and, if asked
      for, `SupportMargin`. It costs a rollout per step, and tens of them where it acts.
    - ``contacts="pyramid"`` or ``"cone"``: those with which the feet that stand now could stay: the textbook's
      whole-body program, `Stance`, as a quadratic program with friction pyramids or with the exact cones. It costs
      a millisecond, and knows nothing of what happens after the first instant.

    To hold other constraints as well, in one projection, put these into a filter's list.

    **What it guarantees.** What `CBFActionFilter` does. With forecasts and a plant that is right, a step that is not
    flagged infeasible or fallback has its contact forces within cone and tolerance, and its joints in range, at every
    evaluation of the physics.

    **What it does not.** All of these constraints are *best effort*, for contact: a foot that comes down sideways
    slides whatever the torques; then the step is counted infeasible, and the control that fails least runs. It does
    not keep a robot on its feet, and it knows of no ground that the model does not have. With the programs an
    unflagged step can slide. Feet that must not slide are another gait: a policy that hops and slides stops walking.

    Args:
        env: Of MuJoCo, with a Box action space that is its model's control range.
        contacts: "forecast", "pyramid" or "cone", see above.
        friction_share: Of the model's friction coefficient that may be counted on, in (0, 1].
        joint_tolerance: How far a joint may press its stop, rad or m: stops in MuJoCo are soft, and policies lean on
            them. None leaves the joints alone.
        zmp_inset: Distance of the zero moment point from the edge of the support polygon, m, positive, wherever
            there is a polygon. None does not ask.
        tolerance: By how much a forecast contact force may miss its cone, as a share of the robot's weight; None is
            0.01. For forecasts only.
        bodies: Names of the bodies whose contacts count; None is every moving body. For forecasts only.
        horizon: Control steps to look ahead for the joints; cover the time that braking them takes; None is 3. For
            forecasts only.
        plant: None reads the env's model.
        fallback: As of `CBFActionFilter`.
        solver: "daqp" or any installed qpsolvers backend.

    Info, at every step: the keys of `CBFActionFilter`, ``whole_body/contacts``, ``whole_body/cone_margin``, and for
    forecasts with a `zmp_inset` ``whole_body/zmp_margin`` and ``whole_body/supported``.

    Raises:
        ConfigurationError: A share outside (0, 1], a negative tolerance, or a body that does not move.
        UnknownNameError: No body of that name.
        UnsupportedEnvError: Not a MuJoCo env, or a robot that touches nothing.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.WholeBodyFilter(gym.make("Ant-v5"))
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> bool(info["whole_body/cone_margin"] >= -0.01 or info["cbf/infeasible"])
        True

    Change log:
        * v0.1.0: added.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        contacts: str = "forecast",
        friction_share: float = 0.7,
        joint_tolerance: float | None = 0.1,
        zmp_inset: float | None = None,
        tolerance: float | None = None,
        bodies: Sequence[str] | None = None,
        horizon: int | None = None,
        plant: Plant | None = None,
        fallback: str | FallbackFunction = "brake",
        solver: str = "daqp",
    ) -> None:
        constraints = _constraints(
            env, contacts, friction_share, tolerance, joint_tolerance, zmp_inset, bodies, horizon
        )
        plant = own_plant(plant)
        gym.utils.RecordConstructorArgs.__init__(
            self,
            contacts=contacts,
            friction_share=friction_share,
            joint_tolerance=joint_tolerance,
            zmp_inset=zmp_inset,
            tolerance=tolerance,
            bodies=None if bodies is None else list(bodies),
            horizon=horizon,
            plant=None if plant is None else PlantTemplate(plant),
            fallback=fallback,
            solver=solver,
        )
        super().__init__(env, constraints, plant=plant, fallback=fallback, solver=solver)


def _constraints(
    env: gym.Env[Any, Any],
    contacts: str,
    friction_share: float,
    tolerance: float | None,
    joint_tolerance: float | None,
    zmp_inset: float | None,
    bodies: Sequence[str] | None,
    horizon: int | None,
) -> list[Constraint]:
    model = getattr(env.unwrapped, "model", None)
    if not isinstance(model, mujoco.MjModel):
        raise UnsupportedEnvError(
            f"WholeBodyFilter needs an env with MuJoCo's .model and .data; {env} has none"
        )
    joints, low, high = stops(model)
    if joint_tolerance is not None:
        joint_tolerance = non_negative("joint_tolerance", joint_tolerance, "rad or m")
        refuse_uncovered_stops(model)
        if not joints:
            raise UnsupportedEnvError(
                "no driven joint of this model has a range: joint_tolerance=None leaves the joints alone"
            )
    elif horizon is not None:
        raise ConfigurationError(
            "horizon is how far to look ahead for the joints, which joint_tolerance=None leaves alone"
        )
    if contacts in ("pyramid", "cone"):
        _only_for_forecasts(contacts, tolerance=tolerance, bodies=bodies, horizon=horizon)
        cone: Any = "exact" if contacts == "cone" else "pyramid"
        return [Stance(friction_share, cone, joint_tolerance=joint_tolerance, zmp_inset=zmp_inset)]
    if contacts != "forecast":
        raise UnknownNameError(f'contacts is "forecast", "pyramid" or "cone", got {contacts!r}')
    found: list[Constraint] = [
        ContactFeasibility(friction_share, TOLERANCE if tolerance is None else tolerance, bodies)
    ]
    if zmp_inset is not None:
        found.append(SupportMargin(zmp_inset))
    if joint_tolerance is not None:
        within = JointPositionLimit(
            lower=(low - joint_tolerance).tolist(),
            upper=(high + joint_tolerance).tolist(),
            joints=[model.joint(j).name for j in joints],
            horizon=HOLDS if horizon is None else horizon,
        )
        found.append(within)
    return found


def _only_for_forecasts(contacts: str, **given: Any) -> None:
    for name, value in given.items():
        if value is not None:
            raise ConfigurationError(
                f'{name} is for contacts="forecast"; the whole-body program of contacts={contacts!r} has none'
            )
