"""Plant: the filter's model of the machine. It may be wrong; violations are always judged on the env."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import gymnasium as gym

from safe_wrappers.errors import Array, UnsupportedEnvError
from safe_wrappers.plants.env_checks import read_attribute


class Trajectory:
    """Where a control leads.

    Attributes:
        control: The one that is held for the first control interval, shape (m,); None: of the present state alone.
        states: Of the plant at k instants in time, shape (k, n).
        holds: Control intervals, of as many instants each.
    """

    def __init__(self, control: Array | None, states: Array, holds: int = 1) -> None:
        self.control, self.states, self.holds = control, states, holds


class Model(ABC):
    """What predicts where a control leads from the observed state."""

    @abstractmethod
    def rollout(self, control: Array | None, horizon: int = 1) -> Any:
        """The trajectory of a control, shape (m,), over so many control intervals: it is held for the first.

        Of None: of the present state, or where the model stops from there, on the way to rest. It has `holds`, as
        `Trajectory` has.
        """

    def sketch(self, control: Array, horizon: int = 1) -> Any:
        """The same, perhaps less exact and cheaper, to learn how it changes with the control."""
        return self.rollout(control, horizon)


class Plant(Model):
    """A control-affine machine `x' = f(x) + g(x) u`, read afresh from an env at every step.

    Attributes:
        control_dt: Control interval in s, once bound: how long one action is held.
        delay_s: Evidence age plus detection plus actuation delay in s; the state that the constraints see is
            predicted over it with the commands in flight.
        lower: Smallest control, the action space's, shape (m,), once bound; -inf: no bound.
        upper: Largest control, likewise.
        observation_id: Number of observations so far.
        model_version: Number of changes of the model, after each of which a filter binds its constraints anew.
        has_acceleration: Whether a control acts as a force, so that `f` and `g` are known.
        can_brake: Whether it knows which states are velocities, as a braking fallback needs.
        simulates: Whether it rolls out actions and policies, as `SimulatorPlant` does.
    """

    control_dt: float
    delay_s: float
    lower: Array
    upper: Array
    _env: Any = None
    observation_id: int = 0
    model_version: int = 0
    has_acceleration: ClassVar[bool] = True
    can_brake: ClassVar[bool] = False
    simulates: ClassVar[bool] = False

    @property
    @abstractmethod
    def state(self) -> Array:
        """The state x, shape (n,)."""

    @property
    @abstractmethod
    def f(self) -> Array:
        """Drift at the state, shape (n,), state units per second."""

    @property
    @abstractmethod
    def g(self) -> Array:
        """Control matrix at the state, shape (n, m)."""

    @abstractmethod
    def bind(self, env: gym.Env[Any, Any]) -> None:
        """Attach to the env that the filter wraps; refuse one that this plant cannot describe."""

    @abstractmethod
    def observe(self) -> None:
        """Take the env's present state."""

    def received(self, observation: Any, info: dict[str, Any]) -> None:
        """Take what the env's reset or step has returned; called before the next `observe`."""

    def step(self, env: gym.Env[Any, Any], action: Any) -> Any:
        """Step the env with what may be executed; what `env.step` returns."""
        return env.step(action)

    def deviation(self) -> str:
        """How the env's last step was not what was decided, in words; "" if it was, or nothing can be compared.

        Asked after `received`, before the next `observe`.
        """
        return ""

    @abstractmethod
    def executed(self, control: Array | None) -> None:
        """Remember a sent control, for the delay; None forgets all (a new episode)."""

    def attribute(self, name: str) -> Any:
        """Read a published fact of the env by name, for example the positions of its hazards."""
        return read_attribute(self._env, name)

    @property
    def acting_range(self) -> tuple[Array, Array] | None:
        """The controls between which the force still changes, shapes (m,); None: all between the bounds."""
        return None

    def drift(self, x: Array) -> Array:
        """The drift at any state, shape (n,); by default that of the present one."""
        return self.f

    def effect(self, x: Array) -> Array:
        """The control matrix at any state, shape (n, m); by default that of the present one."""
        return self.g

    def require_acceleration(self, asker: str) -> None:
        """Refuse a constraint, named by `asker`, whose rows need f and g where there are none."""
        if not self.has_acceleration:
            raise UnsupportedEnvError(f"{asker} needs the acceleration that a control causes")
