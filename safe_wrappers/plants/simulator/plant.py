"""SimulatorPlant: the env's own simulation is the model."""

import contextlib
import copy
import warnings
from collections.abc import Callable, Iterator
from typing import Any, Literal

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

from safe_wrappers.checks import Array, whole_number
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.mujoco.binding import physics_steps
from safe_wrappers.plants.rollouts import Measure, Policy, Rollout, RolloutPlant, View
from safe_wrappers.plants.simulator.simulation import (
    Env,
    Simulation,
    check_replay,
    differing,
    reward_number,
    simulation_of,
)


def known_substeps(raw: Any) -> int:
    """How many physics substeps an unwrapped env is known to take with one action."""
    try:
        return physics_steps(raw) if isinstance(getattr(raw, "model", None), mujoco.MjModel) else 1
    except ConfigurationError:  # it does not say
        return 1


@contextlib.contextmanager
def each_substep(raw: Any, look: Callable[[], None]) -> Iterator[None]:
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


_ROUNDING = 1e-6  # of float32
_CHECK_S = 2.0  # for the check at binding


class SimulatorPlant(RolloutPlant):
    """Rolls out actions in the env itself, from its present state, with all wrappers inside the filter.

    No dynamics are written down. By default the env is copied, MuJoCo's state included. At binding random steps are
    made in the simulation and in the env: both must agree bit for bit, or the env is refused.

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

    Attributes:
        checked_steps: How many steps the check has compared.

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

    def __init__(
        self,
        snapshot: Literal["fork"] | None = None,
        control_dt: float | None = None,
        check_steps: int = 1000,
    ) -> None:
        self._snapshot = snapshot
        super().__init__(control_dt)
        self.check_steps = whole_number("check_steps", check_steps, 0, "steps")
        self.checked_steps = 0
        self.exact = self.check_steps > 0
        self._simulation: Simulation | None = None
        self._compares = self.exact
        self._sent, self._answered = b"", False
        self._foreseen: dict[bytes, tuple[Any, float | None, Measure | None]] = {}

    def bind(self, env: Env) -> None:
        self._take_space(env.action_space)
        self._attach(env)
        self._simulation = simulation_of(env, self._snapshot)
        self.view = View(env.unwrapped, np.zeros(0), {})
        self.substeps = known_substeps(env.unwrapped)
        stepping = getattr(type(env.unwrapped), "_step_mujoco_simulation", None)
        self.judges_substeps = stepping is MujocoEnv._step_mujoco_simulation
        if self.check_steps:
            self.checked_steps = check_replay(self._simulation, self.check_steps, _CHECK_S)
            if self.checked_steps < self.check_steps:
                warnings.warn(
                    f"the simulation of {name_of(env)} was compared with the env on {self.checked_steps:,} random "
                    f"steps, which took {_CHECK_S:g} s, instead of {self.check_steps:,}",
                    stacklevel=2,
                )

    @property
    def simulation(self) -> Simulation:
        """Of the env that it is bound to."""
        assert self._simulation is not None
        return self._simulation

    @property
    def state(self) -> Array:
        """The last observation as numbers, shape (n,); empty where it is no array."""
        observation = self.view.observation
        if isinstance(observation, np.ndarray) and observation.dtype.kind in "fiub":
            return observation.astype(np.float64).reshape(-1)
        return np.zeros(0)

    def observe(self) -> None:
        self.observation_id += 1
        self._foreseen.clear()

    def received(self, observation: Any, info: dict[str, Any]) -> None:
        self._answered = True
        self.view = View(self.simulation.env.unwrapped, observation, info)

    def executed(self, control: Array | None) -> None:
        """Remember it for `deviation`; a new episode may have changed what copies share."""
        if control is None:
            self.simulation.start()
        else:
            self._sent, self._answered = control.tobytes(), False

    def deviation(self) -> str:
        """Where the env's step was not the rollout of what was executed: in the observation, or in what was measured.

        By more than rounding: an env may compute otherwise with a list. From the first one on it is not `exact`.
        """
        if not (self._answered and self._sent in self._foreseen):
            return ""
        observation, value, measure = self._foreseen[self._sent]
        found = differing("observation", observation, self.view.observation, _ROUNDING)
        if found is None and measure is not None:
            found = differing("h", value, measure(self.view), _ROUNDING)
        if found is None:
            return ""
        self.exact = False
        return f"the env's step was not its simulation's: {found}"

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

        def simulated(env: gym.Env[Any, Any]) -> tuple[Rollout, float | None]:
            raw, found, first, passed = env.unwrapped, Rollout(), None, list[float]()

            def look() -> None:
                assert measure is not None
                passed.append(measure(View(raw, None, {})))

            action = self.action(control)
            with each_substep(raw, look) if between else contextlib.nullcontext():
                for step in range(horizon):
                    observation, reward, terminated, truncated, info = env.step(action)
                    view = View(raw, observation, info)
                    found.observations.append(observation if step else copy.deepcopy(observation))
                    found.rewards.append(reward_number(env, reward))
                    if measure is not None:
                        value = measure(view)
                        first = first if step else value
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
            return found, first

        found, value = self.simulation.run(simulated)
        if self._compares:
            self._foreseen[control.tobytes()] = found.observations[0], value, measure
        return found

    def margins(self, measure: Measure, horizon: int) -> Array:
        """Zeros: a rollout is what the env does."""
        return np.zeros(horizon)
