"""FallbackController: the fallback of wrappers that filter nothing."""

from typing import Any

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import Fallback, FallbackFunction
from safe_wrappers.plants.default import default_plant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.common.layer import Env


class FallbackController:
    """A fallback ("brake", "hold", "zero" or a function of the plant) with the plant that it needs, bound to an env.

    `plant` None reads the env's MuJoCo model where the choice needs one. A constraint is bound here; "brake" is then
    its backup control, if it has one.
    """

    def __init__(
        self,
        env: Env,
        choice: str | FallbackFunction,
        plant: Plant | None,
        constraint: Constraint | None = None,
    ) -> None:
        space: Any = env.action_space
        self._low, self._high = np.asarray(space.low, np.float64), np.asarray(space.high, np.float64)
        if plant is None and (callable(choice) or choice == "brake"):
            plant = default_plant(env)
        self.plant, self.constraint = plant, None
        if plant is not None:
            plant.bind(env)
            self.constraint = None if constraint is None else constraint.bind(plant)
            known = self.constraint is not None and self.constraint.has_backup
            if choice == "brake" and not (known or plant.can_brake):
                others = f'with a {type(plant).__name__} choose "hold", "zero" or a function of the plant'
                raise ConfigurationError(f'"brake" needs a MujocoPlant; {others}')
        self._fallback = Fallback(choice, [] if self.constraint is None else [self.constraint])
        self.reset()

    def reset(self) -> None:
        """Forget the episode."""
        self._last = np.clip(np.zeros_like(self._low), self._low, self._high)
        if self.plant is not None:
            self.plant.executed(None)
        self._memory = None if self.constraint is None else self.constraint.start()

    def executed(self, control: Array) -> None:
        """Keep what was sent, for "hold" and for the plant's delay."""
        self._last = control
        if self.plant is not None:
            self.plant.executed(control)

    def command(self) -> Array:
        """The fallback's control at the present state: finite, inside the action box, shape (m,)."""
        readable = True
        if self.plant is not None:
            self.plant.observe()
            readable = bool(np.isfinite(self.plant.state).all())
            if readable and self.constraint is not None:
                self.constraint.observe(self._memory)
        return self._fallback(self.plant, self._last, self._low, self._high, None, readable)
