"""The filter for wheels, for legs and for discrete actions: SlipLimiter, WholeBodyFilter, ActionShield."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.constraints.contact_feasibility import ContactFeasibility, SupportMargin
from safe_wrappers.constraints.joints import JointPositionLimit, stops
from safe_wrappers.constraints.traction import Traction
from safe_wrappers.errors import (
    ActionError,
    ConfigurationError,
    UnsupportedEnvError,
    non_negative,
    numbers_of,
    shown,
)
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.filter.search import DiscreteSearch
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.layer import Env, Step, mujoco_env, refuse_vector_env


class SlipLimiter(CBFActionFilter):
    """Keeps every driven wheel on what seems the stable side of its traction curve, with friction unknown.

    It is `CBFActionFilter` with one `Traction`, whose brake acts as hard as the slip limit allows. **What it does
    not.** A wheel that comes to another ground overshoots for a few control steps, which ``slip/ratio`` shows and no
    flag marks; sideways slip is not limited.

    Args:
        env: Of MuJoCo, with a Box action space that is its model's control range.
        wheels: Names of the driven wheels' hinges.
        max_slip: Largest slip ratio, normalised, in (0, 1).
        friction: Declared lower bound on the peak friction coefficient; None counts on nothing but what it measures.

    Info, at every step: that of `CBFActionFilter` (``cbf/margin`` stays 0), and per wheel ``slip/ratio``,
    ``slip/mu_estimate``.

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
        traction = Traction(wheels, max_slip, friction)
        CBFActionFilter.__init__(self, env, [traction])


class WholeBodyFilter(CBFActionFilter):
    """Keeps a legged robot's contact forces inside their friction cones and its joints off their stops.

    It is `CBFActionFilter` with `ContactFeasibility`, `JointPositionLimit` and, if asked for, `SupportMargin`, which
    read the forces of the plant's simulation at every evaluation of the physics of the control step.

    **What it guarantees.** With a plant that is right, a step that is not flagged infeasible or fallback has its
    contact forces within cone and tolerance, and its joints in range, at every evaluation of the physics. **What it
    does not.** All of these constraints are *best effort*. It does not keep a robot on its feet.

    Args:
        env: Of MuJoCo, with a Box action space that is its model's control range.
        friction_share: Of the model's friction coefficient that may be counted on, in (0, 1].
        joint_tolerance: How far a joint may press its stop, rad or m. None leaves the joints alone.
        zmp_inset: Least distance of the zero moment point from the edge of the support polygon, m, wherever there is
            a polygon. None sets no bound.
        tolerance: By how much a force may miss its cone, as a share of the robot's weight.

    Info, at every step: that of `CBFActionFilter`, ``whole_body/cone_margin``, with a `zmp_inset`
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
        friction_share: float = 0.7,
        joint_tolerance: float | None = 0.1,
        zmp_inset: float | None = None,
        tolerance: float = 0.01,
    ) -> None:
        refuse_vector_env(env, type(self).__name__)
        model = mujoco_env(env, "WholeBodyFilter").model
        constraints: list[Constraint] = [ContactFeasibility(friction_share, tolerance)]
        if zmp_inset is not None:
            constraints.append(SupportMargin(zmp_inset))
        if joint_tolerance is not None:
            wider = non_negative("joint_tolerance", joint_tolerance, "rad or m")
            joints, low, high = stops(model)
            if not joints:
                raise UnsupportedEnvError("no driven joint has a range: pass joint_tolerance=None")
            names = [model.joint(j).name for j in joints]
            lower, upper = (low - wider).tolist(), (high + wider).tolist()
            constraints.append(JointPositionLimit(lower, upper, names, horizon=3))
        CBFActionFilter.__init__(self, env, constraints)


class ActionShield(CBFActionFilter):
    """Executes the policy's discrete action where every constraint admits it, else another, or a fallback.

    **Post-shielding**: of the admitted actions the one that the policy prefers, by `PredictiveShield(value=...)`,
    else the nearest by number. **Pre-shielding**: `action_masks` says before a step which actions are admitted, as
    sb3-contrib's MaskablePPO reads it through `env_method`.

    What is guaranteed is what the constraints promise of a simulation. If no action is admitted, `cbf/infeasible` is
    True, and with "brake" the one that violates least is executed. Where an observation is not a number, the last
    action goes on, unless the fallback is a function.

    Args:
        env: With a Discrete action space, of at most 1,024 actions.
        constraints: As for `CBFActionFilter`; each must judge actions by simulation, as `PredictiveShield` does.
        plant: None simulates the env itself (`SimulatorPlant`).
        fallback: "brake" (a constraint's backup), "hold", or a function of the plant that returns an action.
        margin: As for `CBFActionFilter`.

    Info: that of `CBFActionFilter`; ``proposed_action`` and ``executed_action`` have shape (1,).

    Raises:
        ConfigurationError: Another action space, or too many actions; else as `CBFActionFilter`.
        ActionError: In `step`: not an action of the space.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> upright = sw.constraints.PredictiveShield(lambda x: 0.2 - abs(x[2]), horizon=4, backup=[0, 1])
        >>> env = sw.ActionShield(gym.make("CartPole-v1"), [upright])
        >>> _ = env.reset(seed=0)
        >>> env.action_masks()
        array([ True,  True])
    """

    _search: ClassVar = DiscreteSearch

    def __init__(
        self,
        env: Env,
        constraints: Sequence[Constraint | dict[str, Any]],
        plant: Plant | None = None,
        fallback: str | FallbackFunction = "brake",
        margin: float = 0.0,
    ) -> None:
        if fallback == "zero":
            raise ConfigurationError("a discrete action has no zero: fallback is brake, hold, or a function")
        CBFActionFilter.__init__(self, env, constraints, plant=plant, fallback=fallback, margin=margin)

    def _take_action_space(self, env: Env) -> None:
        space = env.action_space
        if not isinstance(space, gym.spaces.Discrete):
            raise ConfigurationError(
                f"expected Discrete actions, got {space}: use CBFActionFilter for a Box; else give the env these, "
                "and translate its actions in its step"
            )
        if space.n > 1024:
            raise ConfigurationError(f"every action is tried, of which there may be 1,024; got {space}")
        self._low = np.array([space.start], dtype=np.float64)
        self._high = self._low + float(space.n) - 1.0
        self._shape, self._dtype = self._low.shape, np.float64

    def step(self, action: Any) -> Step:
        """Shield the action and step the env with what may be executed."""
        given = numbers_of(action)
        if given is None or not self.action_space.contains(action):
            raise ActionError(f"expected an action of {self.action_space}, got {shown(action)}")
        return super().step(np.atleast_1d(given.astype(np.float64)))

    def action_masks(self) -> NDArray[np.bool_]:
        """Which actions would be executed as they are in the env's present state.

        Returns:
            Shape (n,). If none is admitted, the one that violates least alone is; if the state is not a number, all.
        """
        self.observe()
        every = np.arange(self._low[0], self._high[0] + 1.0)[:, None]
        engine = self.filter
        if engine.margin != engine.margin:
            return np.ones(len(every), dtype=bool)
        admitted = np.array([engine.admits(control) for control in every])
        if not admitted.any():
            slacks = [min(c.slack(control) / c.spec.scale for c in engine.bound) for control in every]
            admitted[int(np.argmax(slacks))] = True
        return admitted
