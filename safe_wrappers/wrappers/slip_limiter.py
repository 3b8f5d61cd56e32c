"""SlipLimiter: the filter with Traction alone."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym

from safe_wrappers.constraints.traction import Traction
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.default import PlantTemplate, own_plant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter


class SlipLimiter(CBFActionFilter):
    """Keeps every driven wheel on what seems the stable side of its traction curve, with friction unknown.

    It is `CBFActionFilter` with one `Traction`; put `Traction` into a filter's list to hold it together with other
    constraints, in one projection.

    **What it guarantees.** What `CBFActionFilter` does. **What it does not.** See `Traction`: a wheel that comes to
    another ground overshoots for one or two control steps; wheels that are driven against each other overshoot on any
    ground (dry, limit 0.15, commands drawn for each wheel: a slip above 0.17 in 0.05 % of the steps if drawn anew at
    every step, in 1.5 % if full ones are held for up to 19 steps, three of them in a row at most); sideways slip is
    not limited, and obstacles are none of its business. No flag marks an overshoot; ``slip/ratio`` shows it.

    Args:
        env: Of MuJoCo, with a Box action space that is its model's control range.
        wheels: Names of the driven wheels' hinges.
        max_slip: Largest slip ratio, normalised, in (0, 1).
        friction: Declared lower bound on the peak friction coefficient; None counts on nothing but what it measures.
        regularization: Speed below which slip is counted against it, m/s.
        plant: None reads the env's model.
        fallback: As of `CBFActionFilter`. "brake" here brakes as hard as the slip limit allows.
        solver: "daqp" or any installed qpsolvers backend.
        margin: Slip kept free below the limit.

    Info, at every step: the keys of `CBFActionFilter` (``cbf/margin`` stays 0), and arrays with one entry
    per wheel: ``slip/ratio``, ``slip/limited``, ``slip/mu_estimate``, ``slip/mu_std``.

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
        >>> bool(info["slip/limited"].all())
        True
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        wheels: Sequence[str],
        max_slip: float = 0.15,
        friction: float | None = None,
        regularization: float = 0.5,
        plant: Plant | None = None,
        fallback: str | FallbackFunction = "brake",
        solver: str = "daqp",
        margin: float = 0.0,
    ) -> None:
        traction = Traction(wheels, max_slip, friction, regularization, margin)
        plant = own_plant(plant)
        gym.utils.RecordConstructorArgs.__init__(
            self,
            wheels=list(wheels),
            max_slip=max_slip,
            friction=friction,
            regularization=regularization,
            plant=None if plant is None else PlantTemplate(plant),
            fallback=fallback,
            solver=solver,
            margin=margin,
        )
        super().__init__(env, [traction], plant=plant, fallback=fallback, solver=solver)
