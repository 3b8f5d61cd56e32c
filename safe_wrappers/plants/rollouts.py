"""What a plant can do that simulates: rollouts of a control and a policy, judged step by step."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, NoReturn

import gymnasium as gym
import numpy as np

from safe_wrappers.checks import Array, numbers_of, positive, shown
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import check_timing, name_of, read_attribute, refuse_second_env
from safe_wrappers.plants.plant import Plant


class View(NamedTuple):
    """What can be seen of a state: the unwrapped env (None of an identified model), observation and info."""

    env: Any
    observation: Any
    info: dict[str, Any]


class NotFiniteError(ConfigurationError):
    """A backup or a policy has given an action that is not finite."""


Measure = Callable[[View], float]
Policy = Callable[[View], Any]
"""Gives an action of the env's action space."""


@dataclass
class Rollout:
    """What a simulation has seen.

    Attributes:
        observations: After each step.
        rewards: Of each step; NaN where the plant does not know them.
        values: What was measured after each step, shape (k,).
        ended: The episode terminated or was truncated.
        reached: The set in which it may stop was reached.
    """

    observations: list[Any] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    ended: bool = False
    reached: bool = False

    @property
    def holds(self) -> int:
        """Control intervals."""
        return len(self.observations)


class RolloutPlant(Plant):
    """A plant that predicts by rollouts alone; it has neither f nor g."""

    has_acceleration: ClassVar[bool] = False
    simulates: ClassVar[bool] = True
    simulates_env: ClassVar[bool] = True
    """Whether a `View` of a rollout has the env and its info; else only the observation."""
    exact: bool = False
    """Whether rollouts were checked to be what the env does, its noise included."""
    substeps: int = 1
    """Physics substeps of a control step that are known of."""
    judges_substeps: bool = False
    """Whether rollouts can be measured at each of them, by a measure of the env alone."""
    info_keys: ClassVar[tuple[str, ...]] = ()
    """The keys that `info` writes."""
    lower: Array = np.zeros(0)  #: of the control, shape (m,), once bound
    upper: Array = np.zeros(0)
    delay_s = 0.0
    _space: gym.Space[Any]
    _env: gym.Env[Any, Any] | None = None
    _control_dt: float | None = None
    view: View
    """What was returned last by the env's reset or step."""

    def __init__(self, control_dt: float | None) -> None:
        self._given_control_dt = None if control_dt is None else positive("control_dt", control_dt, "s")

    def _attach(self, env: gym.Env[Any, Any]) -> None:
        """Be an env's from now on."""
        refuse_second_env(self._env, env)
        if self._given_control_dt is not None or env.has_wrapper_attr("dt"):
            self._control_dt = check_timing(env, self._given_control_dt)
        self._env = env

    @property
    def control_dt(self) -> float:  # type: ignore[override]
        """Control interval, s; an error where nothing says it."""
        if self._control_dt is None:
            assert self._env is not None
            raise ConfigurationError(
                f"{name_of(self._env)} does not say how long a step lasts (it has no attribute dt): pass "
                f"{type(self).__name__}(control_dt=...), in seconds"
            )
        return self._control_dt

    @property
    def f(self) -> NoReturn:
        """Raises: nothing is known of it."""
        self.require_acceleration("f")

    @property
    def g(self) -> NoReturn:
        """Raises likewise."""
        self.require_acceleration("g")

    def attribute(self, name: str) -> Any:
        """Read a published fact of the env."""
        assert self._env is not None
        return read_attribute(self._env, name)

    def require_acceleration(self, asker: str) -> NoReturn:
        """Raise an error that says what works."""
        raise UnsupportedEnvError(
            f"{asker} needs the acceleration that a control causes; a {type(self).__name__} knows only where actions "
            "lead: use PredictiveShield"
        )

    def step(self, env: gym.Env[Any, Any], action: Any) -> Any:
        """Step the env; a discrete action is a control, and becomes what the space has."""
        return super().step(env, self.action(action) if self.discrete else action)

    def _take_space(self, space: gym.Space[Any]) -> None:
        """The bounds of controls, which are actions as arrays of float64."""
        if isinstance(space, gym.spaces.Box) and len(space.shape) == 1:
            if not space.is_bounded():
                raise UnsupportedEnvError(
                    f"expected bounded actions, got {space}; bound the env's action space"
                )
            self.lower, self.upper = space.low.astype(float), space.high.astype(float)
        elif isinstance(space, gym.spaces.Discrete):
            self.lower = np.array([float(space.start)])
            self.upper = self.lower + float(space.n - 1)
        else:
            raise UnsupportedEnvError(
                f"expected a Box of shape (m,) or a Discrete action space, got {space}; give "
                "the env one of these from gymnasium.spaces.flatten_space, and gymnasium.spaces.unflatten in its step"
            )
        self._space = space

    @property
    def discrete(self) -> bool:
        """Whether actions are whole numbers."""
        return not isinstance(self._space, gym.spaces.Box)

    def neighbours(self, control: Array, points: Array, more: Sequence[Array] = ()) -> list[Array]:
        """Other controls, the nearest first: all of discrete ones.

        Args:
            control: Shape (m,).
            points: Of the unit cube, shape (k, m): ends of lines from the control through the box, on which the
                neighbours lie, from the end of the first to 5 % of the last.
            more: Further ones.
        """
        if self.discrete:
            counts = (self.upper - self.lower + 1.0).astype(int)
            every = self.lower + np.stack(np.unravel_index(np.arange(counts.prod()), counts), axis=1)
        else:
            shares = np.geomspace(1.0, 0.05, max(1, len(points)))[: len(points), None]
            between = control + shares * (self.lower + points * (self.upper - self.lower) - control)
            every = np.array([*more, *between.astype(self._space.dtype).astype(np.float64)])
        distances = np.linalg.norm(every - control, axis=1)
        return [every[i] for i in np.argsort(distances, kind="stable") if distances[i] > 0.0]

    def action(self, control: Array) -> Any:
        """The env's action for a control, shape (m,): in the space's dtype, unless it is not a number of that."""
        if isinstance(self._space, gym.spaces.Discrete):
            return int(control[0])
        rounded = control.astype(self._space.dtype)
        return rounded if bool((rounded == control).all()) else control.copy()

    def control(self, action: Any, of: str) -> Array:
        """The control for an action, inside a Box and in its dtype; `of` says in messages whose it is.

        Raises:
            NotFiniteError: Not finite.
            ConfigurationError: Another shape, or no action of a discrete space.
        """
        given = numbers_of(action)
        wanted = f"{of} must be a finite action of {self._space}, got {shown(action)}"
        if given is None or np.atleast_1d(given).shape != self.lower.shape:
            raise ConfigurationError(wanted)
        control = np.atleast_1d(given).astype(np.float64)
        if not np.isfinite(control).all():
            raise NotFiniteError(wanted)
        clipped = np.clip(control, self.lower, self.upper)
        if self.discrete and bool((np.rint(clipped) != control).any()):
            raise ConfigurationError(wanted)
        return clipped.astype(self._space.dtype).astype(np.float64)

    def rollout(
        self,
        control: Array | None,
        horizon: int = 1,
        policy: Policy | None = None,
        measure: Measure | None = None,
        least: float = -np.inf,
        until: Callable[[View], bool] | None = None,
        between: bool = False,
    ) -> Rollout:
        """Simulate a control, then a policy, from the env's present state; of None, the present state alone.

        Args:
            control: For the first step, shape (m,).
            horizon: Steps in all, at most; fewer where the episode ends.
            policy: Takes a `View`, returns an action; None holds the control.
            measure: Takes a `View`, returns a number.
            least: A measured number below it, or NaN, ends the rollout.
            until: Takes a `View`; where it is True the rollout ends.
            between: Measure the env at physics substeps, too, where the plant `judges_substeps`; the least of a
                step counts. The `View` has no observation there.
        """
        if control is None:
            return Rollout([self.view.observation])
        return self.simulate(control, horizon, policy, measure, least, until, between)

    @abstractmethod
    def simulate(
        self,
        control: Array,
        horizon: int,
        policy: Policy | None,
        measure: Measure | None,
        least: float,
        until: Callable[[View], bool] | None,
        between: bool,
    ) -> Rollout:
        """A `rollout` of a control."""

    @abstractmethod
    def margins(self, measure: Measure, horizon: int) -> Array:
        """By how much a measure may be worse than predicted after each step, shape (horizon,), in its unit."""

    def info(self) -> dict[str, Any]:
        """The info keys of its own, always the same, after what was received last."""
        return {}
