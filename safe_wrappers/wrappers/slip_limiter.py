"""SlipLimiter: the filter with Traction alone."""

from collections.abc import Sequence

from safe_wrappers.constraints.traction import Traction
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.default import own_plant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.common.layer import Env


class SlipLimiter(CBFActionFilter):
    """Keeps every driven wheel on what seems the stable side of its traction curve, with friction unknown.

    It is `CBFActionFilter` with one `Traction`. **What it guarantees.** What `CBFActionFilter` does. **What it does
    not.** A wheel that comes to another ground overshoots for a few control steps, which ``slip/ratio`` shows and no
    flag marks; sideways slip is not limited. See `Traction`.

    Args:
        env: Of MuJoCo, with a Box action space that is its model's control range.
        wheels: Names of the driven wheels' hinges.
        max_slip: Largest slip ratio, normalised, in (0, 1).
        friction: Declared lower bound on the peak friction coefficient; None counts on nothing but what it measures.
        regularization: Speed below which slip is counted against it, m/s.
        plant: None reads the env's model.
        fallback: As of `CBFActionFilter`. "brake" here brakes as hard as the slip limit allows.
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
        env: Env,
        wheels: Sequence[str],
        max_slip: float = 0.15,
        friction: float | None = None,
        regularization: float = 0.5,
        plant: Plant | None = None,
        fallback: str | FallbackFunction = "brake",
        margin: float = 0.0,
    ) -> None:
        arguments = dict(locals())
        traction = Traction(wheels, max_slip, friction, regularization, margin)
        plant = own_plant(plant)
        self._record(arguments, wheels=list(wheels), plant=plant)
        CBFActionFilter.__init__(self, env, [traction], plant=plant, fallback=fallback)
