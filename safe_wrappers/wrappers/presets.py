"""SlipLimiter and WholeBodyFilter: the filter with constraints chosen for wheels and for legs."""

from collections.abc import Sequence
from typing import Any

import mujoco

from safe_wrappers.checks import non_negative
from safe_wrappers.constraints.contact_feasibility import ContactFeasibility, Stance, SupportMargin
from safe_wrappers.constraints.joints import JointPositionLimit, refuse_uncovered_stops, stops
from safe_wrappers.constraints.traction import Traction
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.layer import Env, refuse_vector_env


class SlipLimiter(CBFActionFilter):
    """Keeps every driven wheel on what seems the stable side of its traction curve, with friction unknown.

    It is `CBFActionFilter` with one `Traction`, whose brake acts as hard as the slip limit allows. **What it
    guarantees.** What `CBFActionFilter` does. **What it does not.** A wheel that comes to another ground overshoots
    for a few control steps, which ``slip/ratio`` shows and no flag marks; sideways slip is not limited. See
    `Traction`.

    Args:
        env: Of MuJoCo, with a Box action space that is its model's control range.
        wheels: Names of the driven wheels' hinges.
        max_slip: Largest slip ratio, normalised, in (0, 1).
        friction: Declared lower bound on the peak friction coefficient; None counts on nothing but what it measures.

    Info, at every step: the keys of `CBFActionFilter` (``cbf/margin`` stays 0), and arrays with one entry
    per wheel: ``slip/ratio``, ``slip/mu_estimate``.

    Raises:
        ConfigurationError: A joint that is no driven wheel, a radius of zero, or a number out of its range.
        UnknownNameError: No joint of that name.
        UnsupportedEnvError: Not a MuJoCo env.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = gym.make("SafeRover-v0")
        >>> env = sw.SlipLimiter(env, wheels=["front_left", "front_right", "rear_left", "rear_right"])
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.high)[4]
        >>> bool(info["cbf/intervened"])
        True
    """

    def __init__(
        self,
        env: Env,
        wheels: Sequence[str],
        max_slip: float = 0.15,
        friction: float | None = None,
    ) -> None:
        arguments = dict(locals())
        traction = Traction(wheels, max_slip, friction)
        self._record(arguments, wheels=list(wheels))
        CBFActionFilter.__init__(self, env, [traction])


TOLERANCE = 0.01
"""By how much a contact force may miss its cone unless told otherwise, as a share of the robot's weight."""
HOLDS = 3
"""Control steps to look ahead for the joints, of which braking takes so many."""


class WholeBodyFilter(CBFActionFilter):
    """Keeps a legged robot's contact forces inside their friction cones and its joints off their stops.

    With ``contacts="forecast"`` the forces are those that the plant's simulation gives at every evaluation of the
    physics of the control step (`ContactFeasibility`, `JointPositionLimit` and, if asked for, `SupportMargin`); with
    "pyramid" or "cone" those with which the feet that stand now could stay (`Stance`).

    **What it guarantees.** What `CBFActionFilter` does. With forecasts and a plant that is right, a step that is not
    flagged infeasible or fallback has its contact forces within cone and tolerance, and its joints in range, at every
    evaluation of the physics. **What it does not.** All of these constraints are *best effort*. With "pyramid" and
    "cone" an unflagged step can slide. It does not keep a robot on its feet.

    Args:
        env: Of MuJoCo, with a Box action space that is its model's control range.
        contacts: "forecast", "pyramid" or "cone", see above.
        friction_share: Of the model's friction coefficient that may be counted on, in (0, 1].
        joint_tolerance: How far a joint may press its stop, rad or m. None leaves the joints alone.
        zmp_inset: Distance of the zero moment point from the edge of the support polygon, m, positive, wherever
            there is a polygon, for forecasts. None sets no bound.
        tolerance: By how much a forecast force may miss its cone, as a share of the robot's weight; None is 0.01.

    Info, at every step: the keys of `CBFActionFilter`, ``whole_body/cone_margin``, and with a `zmp_inset`
    ``whole_body/zmp_margin``.

    Raises:
        ConfigurationError: A share outside (0, 1], or a negative tolerance.
        UnsupportedEnvError: Not a MuJoCo env, or a robot that touches nothing.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.WholeBodyFilter(gym.make("Ant-v5"))
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> bool(info["whole_body/cone_margin"] >= -0.01 or info["cbf/infeasible"])
        True
    """

    def __init__(
        self,
        env: Env,
        contacts: str = "forecast",
        friction_share: float = 0.7,
        joint_tolerance: float | None = 0.1,
        zmp_inset: float | None = None,
        tolerance: float | None = None,
    ) -> None:
        arguments = dict(locals())
        refuse_vector_env(env, type(self).__name__)
        model = getattr(env.unwrapped, "model", None)
        if not isinstance(model, mujoco.MjModel):
            raise UnsupportedEnvError(f"WholeBodyFilter needs MuJoCo's .model and .data; {env} has none")
        if joint_tolerance is not None:
            joint_tolerance = non_negative("joint_tolerance", joint_tolerance, "rad or m")
            refuse_uncovered_stops(model)
            if not stops(model)[0]:
                raise UnsupportedEnvError("no driven joint has a range: pass joint_tolerance=None")
        constraints: list[Constraint]
        if contacts in ("pyramid", "cone"):
            for name in ("zmp_inset", "tolerance"):
                if arguments[name] is not None:
                    raise ConfigurationError(f'{name} is for contacts="forecast", not for {contacts!r}')
            cone: Any = "exact" if contacts == "cone" else "pyramid"
            constraints = [Stance(friction_share, cone, joint_tolerance=joint_tolerance)]
        elif contacts == "forecast":
            tolerance = TOLERANCE if tolerance is None else tolerance
            constraints = [ContactFeasibility(friction_share, tolerance)]
            if zmp_inset is not None:
                constraints.append(SupportMargin(zmp_inset))
            if joint_tolerance is not None:
                joints, low, high = stops(model)
                ranges = (low - joint_tolerance).tolist(), (high + joint_tolerance).tolist()
                names = [model.joint(j).name for j in joints]
                constraints.append(JointPositionLimit(*ranges, joints=names, horizon=HOLDS))
        else:
            raise UnknownNameError(f'contacts is "forecast", "pyramid" or "cone", got {contacts!r}')
        self._record(arguments)
        CBFActionFilter.__init__(self, env, constraints)
