"""ActionShield: CBFActionFilter for discrete actions."""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import numbers_of, shown
from safe_wrappers.errors import ActionError, ConfigurationError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.filter.search import DiscreteSearch
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter
from safe_wrappers.wrappers.layer import Env, Step

_MOST = 1024


class ActionShield(CBFActionFilter):
    """Executes the policy's discrete action where every constraint admits it, else another, or a fallback.

    **Post-shielding**: of the admitted actions the one that the policy prefers, by `PredictiveShield(value=...)`,
    else the nearest by number. **Pre-shielding**: `action_masks` says before a step which actions are admitted, as
    sb3-contrib's MaskablePPO reads it through `env_method`. Both may be used together.

    What is guaranteed is what the constraints promise of a simulation: see `PredictiveShield`. If no action is
    admitted, `cbf/infeasible` is True, and the one that violates least is executed. Where an observation is not a
    number, the last action goes on.

    Args:
        env: With a Discrete action space, of at most 1,024 actions.
        constraints: As for `CBFActionFilter`; each must judge actions by simulation, as `PredictiveShield` does.
        plant: None simulates the env itself (`SimulatorPlant`).
        fallback: "brake" (a constraint's backup), "hold", or a function of the plant that returns an action.
        margin: As for `CBFActionFilter`.

    Info: the keys of `CBFActionFilter`; ``proposed_action`` and ``executed_action`` have shape (1,).
    ``cbf/correction`` is the distance of their numbers.

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
        if space.n > _MOST:
            raise ConfigurationError(f"every action is tried, of which there may be {_MOST:,}; got {space}")
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
