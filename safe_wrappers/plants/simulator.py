"""SimulatorPlant: a control and then a policy, simulated step by step in the env itself."""

import contextlib
import copy
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, NoReturn

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnsupportedEnvError,
    numbers_of,
    positive,
    shown,
    whole_number,
)
from safe_wrappers.plants.copies import Simulation, differing, reward_number
from safe_wrappers.plants.env_checks import check_timing, name_of, refuse_second_env
from safe_wrappers.plants.mujoco.binding import physics_steps
from safe_wrappers.plants.plant import Plant

_ROUNDING = 1e-6  # of float32
_CHECK_S = 2.0  # for the check at binding


class View(NamedTuple):
    """What can be seen of a state: the unwrapped env, observation and info."""

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
        rewards: Of each step.
        values: What was measured after each step, shape (k,).
        ended: The episode terminated or was truncated.
        reached: The set in which it may stop was reached.
        first: What was measured at the end of the first step; None: nothing.
    """

    observations: list[Any] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    ended: bool = False
    reached: bool = False
    first: float | None = None

    @property
    def holds(self) -> int:
        """Control intervals."""
        return len(self.observations)


class SimulatorPlant(Plant):
    """Rolls out actions in the env itself, from its present state, with all wrappers inside the filter.

    No dynamics are written down. By default the env is copied, MuJoCo's state included. At binding random steps are
    made in a simulation and once more in a simulation of that: both must agree bit for bit, or the env is refused.

    **It knows what will be drawn**: the random generator of the env belongs to its state, so that a rollout has the
    noise that the env will have. Only a simulator has this privilege.

    **After every step** what the env has returned is compared with the rollout of the executed action. From the first
    difference on (a generator that copies share, a clock, another process) nothing is proved, and `cbf/mismatch` says
    at which steps it was.

    Args:
        snapshot: "fork" simulates in a child process, for envs that cannot be copied, such as Box2D's (a model as
            backup then computes in the child, where torch must have one thread). None: see above.
        control_dt: Control interval, s; None takes the env's `dt`. An env without `dt` has none, and wrappers that
            count in seconds ask for it.
        check_steps: Random steps of the check at binding; 0 checks nothing. At most 2 s: a warning says where
            that was too few.

    It predicts by rollouts alone, and has neither f nor g.

    Attributes:
        checked_steps: How many steps the check has compared.
        exact: Whether rollouts were checked to be what the env does, its noise included.
        substeps: Physics substeps of a control step that are known of.
        discrete: Whether actions are whole numbers.
        judges_substeps: Whether rollouts can be measured at each of them, by a measure of the env alone.
        view: What was returned last by the env's reset or step.

    Raises:
        UnsupportedEnvError: The env cannot be copied, or its simulation differs from it; the message says where.
        ConfigurationError: A wrapper inside that records; a wrong control interval.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> upright = lambda x: 0.2 - abs(x[2])  # rad, of CartPole's observation
        >>> shield = sw.constraints.PredictiveShield(upright, horizon=10, backup=[0, 1])
        >>> plant = sw.SimulatorPlant(control_dt=0.02)
        >>> env = sw.ActionShield(gym.make("CartPole-v1"), [shield], plant=plant)
    """

    has_acceleration: ClassVar[bool] = False
    simulates: ClassVar[bool] = True
    checked_steps = 0
    substeps: int = 1
    discrete: bool = False
    judges_substeps: bool = False
    delay_s = 0.0
    view: View
    _control_dt: float | None = None
    _simulation: Simulation

    def __init__(
        self,
        snapshot: Literal["fork"] | None = None,
        control_dt: float | None = None,
        check_steps: int = 1000,
    ) -> None:
        self._given_control_dt = None if control_dt is None else positive("control_dt", control_dt, "s")
        self._foreseen: dict[bytes, tuple[Any, float | None, Measure | None]] = {}
        self._snapshot = snapshot
        self.check_steps = whole_number("check_steps", check_steps, 0, "steps")
        self.exact = self.check_steps > 0
        self._sent = b""

    def bind(self, env: gym.Env[Any, Any]) -> None:
        refuse_second_env(self._env, env)
        space = env.action_space
        self.discrete = isinstance(space, gym.spaces.Discrete)
        if isinstance(space, gym.spaces.Discrete):
            self.lower = np.array([float(space.start)])
            self.upper = self.lower + float(space.n - 1)
        elif isinstance(space, gym.spaces.Box) and len(space.shape) == 1 and space.is_bounded():
            self.lower, self.upper = space.low.astype(float), space.high.astype(float)
        else:
            raise UnsupportedEnvError(
                f"expected bounded actions of shape (m,) in a Box, or Discrete ones, got {space}; give the env's "
                "own action_space finite bounds, or flatten it (gymnasium.spaces.flatten_space and unflatten)"
            )
        if self._given_control_dt is not None or env.has_wrapper_attr("dt"):
            self._control_dt = check_timing(env, self._given_control_dt)
        with contextlib.suppress(ConfigurationError):  # it does not say
            if isinstance(getattr(env.unwrapped, "model", None), mujoco.MjModel):
                self.substeps = physics_steps(env.unwrapped)
        self._env, self._space = env, space
        self._simulation = Simulation(env, self._snapshot)
        self.view = View(env.unwrapped, np.zeros(0), {})
        stepping = getattr(type(env.unwrapped), "_step_mujoco_simulation", None)
        self.judges_substeps = stepping is MujocoEnv._step_mujoco_simulation
        if self.check_steps:
            self.checked_steps = self._simulation.check(self.check_steps, _CHECK_S)
            if self.checked_steps < self.check_steps:
                warnings.warn(
                    f"the simulation of {name_of(env)} was compared with the env on {self.checked_steps:,} random "
                    f"steps, which took {_CHECK_S:g} s, instead of {self.check_steps:,}",
                    stacklevel=2,
                )

    @property
    def state(self) -> Array:
        """The last observation as numbers, shape (n,); empty where it is no array."""
        observation = self.view.observation
        if isinstance(observation, np.ndarray) and observation.dtype.kind in "fiub":
            return observation.astype(np.float64).reshape(-1)
        return np.zeros(0)

    def received(self, observation: Any, info: dict[str, Any]) -> None:
        self.view = View(self._env.unwrapped, observation, info)

    def executed(self, control: Array | None) -> None:
        """Remember it for `deviation`; a new episode may have changed what copies share."""
        if control is None:
            self._simulation.start()
        self._sent = b"" if control is None else control.tobytes()

    def deviation(self) -> str:
        """Where the env's step was not the rollout of what was executed: in the observation, or in what was measured.

        By more than rounding: an env may compute otherwise with a list. From the first one on it is not `exact`.
        """
        if not self.check_steps or self._sent not in self._foreseen:
            return ""
        observation, value, measure = self._foreseen[self._sent]
        found = differing("observation", observation, self.view.observation, _ROUNDING)
        if found is None and measure is not None:
            found = differing("h", value, measure(self.view), _ROUNDING)
        if found is None:
            return ""
        self.exact = False
        return f"the env's step was not its simulation's: {found}"

    @property
    def control_dt(self) -> float:  # type: ignore[override]
        """Control interval, s; an error where nothing says it."""
        return check_timing(self._env) if self._control_dt is None else self._control_dt

    @property
    def f(self) -> NoReturn:
        """Raises, as `g` does: nothing is known of them."""
        self.require_acceleration("f or g")

    g = f

    def require_acceleration(self, asker: str) -> NoReturn:
        raise UnsupportedEnvError(
            f"{asker} needs the acceleration that a control causes; a {type(self).__name__} knows only where actions "
            "lead: use PredictiveShield"
        )

    def observe(self) -> None:
        self.observation_id += 1
        self._foreseen.clear()

    def step(self, env: gym.Env[Any, Any], action: Any) -> Any:
        """Step the env; a discrete action is a control, and becomes what the space has."""
        return super().step(env, self.action(action) if self.discrete else action)

    def neighbours(self, control: Array, points: Array, more: Sequence[Array] = ()) -> list[Array]:
        """Other controls, the nearest first: all of discrete ones.

        Args:
            control: Shape (m,).
            points: Of the unit cube, shape (k, m): ends of lines from the control through the box, on which the
                neighbours lie, from the end of the first to 5 % of the last.
            more: Further ones.
        """
        if self.discrete:
            every = np.arange(self.lower[0], self.upper[0] + 1.0)[:, None]
        else:
            shares = np.geomspace(1.0, 0.05, max(1, len(points)))[: len(points), None]
            between = control + shares * (self.lower + points * (self.upper - self.lower) - control)
            every = np.array([*more, *between.astype(self._space.dtype).astype(np.float64)])
        distances = np.linalg.norm(every - control, axis=1)
        return [every[i] for i in np.argsort(distances, kind="stable") if distances[i] > 0.0]

    def action(self, control: Array) -> Any:
        """The env's action for a control, shape (m,): in the space's dtype, unless it is not a number of that."""
        if self.discrete:
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
        control = np.zeros(0) if given is None else np.atleast_1d(given).astype(np.float64)
        if control.shape != self.lower.shape:
            raise ConfigurationError(wanted)
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
        first = self.action(control)

        def simulated(env: gym.Env[Any, Any]) -> Rollout:
            raw, found, action = env.unwrapped, Rollout(), first
            passed: list[float] = []

            def look() -> None:
                assert measure is not None
                passed.append(measure(View(raw, None, {})))

            with _each_substep(raw, look) if between else contextlib.nullcontext():
                for step in range(horizon):
                    observation, reward, terminated, truncated, info = env.step(action)
                    view = View(raw, observation, info)
                    found.observations.append(observation if step else copy.deepcopy(observation))
                    found.rewards.append(reward_number(env, reward))
                    if measure is not None:
                        value = measure(view)
                        found.first = found.first if step else value
                        found.values.append(float(np.min([*passed, value])))
                        passed.clear()
                        if not found.values[-1] >= least:
                            break
                    found.ended = bool(terminated or truncated)
                    found.reached = until is not None and until(view)
                    if found.ended or found.reached:
                        break
                    if policy is not None and step + 1 < horizon:
                        action = policy(view)
            return found

        found: Rollout = self._simulation.run(simulated)
        self._foreseen[control.tobytes()] = found.observations[0], found.first, measure
        return found


@contextlib.contextmanager
def _each_substep(raw: Any, look: Callable[[], None]) -> Iterator[None]:
    """Let an env simulate substep by substep, which MuJoCo makes the same of, bit for bit, and look after each."""
    simulate = raw._step_mujoco_simulation

    def one_by_one(ctrl: Any, n_frames: int) -> None:
        for _ in range(n_frames):
            simulate(ctrl, 1)
            look()

    raw._step_mujoco_simulation = one_by_one
    try:
        yield
    finally:
        del raw._step_mujoco_simulation
