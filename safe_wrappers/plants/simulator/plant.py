"""SimulatorPlant: the env's own simulation is the model."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from safe_wrappers.checks import Array, positive, whole_number
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.rollouts import Measure, Policy, Rollout, RolloutPlant, View
from safe_wrappers.plants.simulator.replay_check import check_replay
from safe_wrappers.plants.simulator.simulation import (
    Env,
    Simulation,
    Snapshot,
    fresh_generator,
    simulation_of,
)


class SimulatorPlant(RolloutPlant):
    """Rolls out actions in the env itself, from its present state, with all wrappers inside the filter.

    No dynamics are written down. By default the env is copied, MuJoCo's state included; an env with `get_state` and
    `set_state`, or `clone_state` and `restore_state`, is restored by these. At binding random steps are made in the
    simulation and in the env: both must agree bit for bit, or the env is refused.

    **It knows what will be drawn**: the random generator of the env belongs to its state, so that a rollout has the
    noise that the env will have. Only a simulator has this privilege; `same_noise=False` takes it away, and then
    rollouts are samples, and prove nothing about the env.

    Args:
        snapshot: `(save, restore)`: functions `save(env)` and `restore(env, state)` of the unwrapped env, which is
            then itself simulated; or "fork", which simulates in a child process, for envs that cannot be copied, such
            as Box2D's (a model as backup then computes in the child, where torch must have one thread). None: see
            above.
        control_dt: Control interval, s; None takes the env's `dt`. An env without `dt` has none, and wrappers that
            count in seconds ask for it.
        same_noise: Whether rollouts draw the random numbers that the env will draw.
        check_steps: Random steps of the check at binding; 0 checks nothing.
        check_s: How long this check may take, s, before it ends with fewer steps, and a warning.

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
        snapshot: Snapshot = None,
        control_dt: float | None = None,
        same_noise: bool = True,
        check_steps: int = 1000,
        check_s: float = 2.0,
    ) -> None:
        self._snapshot, self.same_noise = snapshot, bool(same_noise)
        super().__init__(control_dt)
        self.check_steps = whole_number("check_steps", check_steps, 0, "steps")
        self.check_s, self.checked_steps = positive("check_s", check_s, "s"), 0
        self.exact = self.same_noise and self.check_steps > 0
        self._simulation: Simulation | None = None

    def bind(self, env: Env) -> None:
        """Attach to an env, and check that its simulation is the env."""
        self._take_space(env.action_space)
        self._attach(env)
        self._simulation = simulation_of(env, self._snapshot)
        self.view = View(env.unwrapped, np.zeros(0), {})
        if self.check_steps:
            self.checked_steps = check_replay(self._simulation, self.check_steps, self.check_s)
            if self.checked_steps < self.check_steps:
                needed_s = math.ceil(1.2 * self.check_s * self.check_steps / self.checked_steps)
                warnings.warn(
                    f"the simulation of {name_of(env)} was compared with the env on {self.checked_steps:,} random "
                    f"steps, which took {self.check_s:g} s, instead of {self.check_steps:,}; for all of them pass "
                    f"plant=SimulatorPlant(check_s={needed_s})",
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
        """Every rollout starts where the env is."""
        self.observation_id += 1

    def received(self, observation: Any, info: dict[str, Any]) -> None:
        """Take what the env's reset or step has returned."""
        self.view = View(self.simulation.env.unwrapped, observation, info)

    def executed(self, control: Array | None) -> None:
        """A new episode may have changed what copies share."""
        if control is None:
            self.simulation.start()

    def rollout(
        self,
        control: Array,
        horizon: int,
        policy: Policy | None = None,
        measure: Measure | None = None,
        least: float = -np.inf,
        until: Callable[[View], bool] | None = None,
    ) -> Rollout:
        """Simulate a control, then a policy, from the env's present state: see `RolloutPlant.rollout`."""

        def simulated(env: gym.Env[Any, Any]) -> Rollout:
            if not self.same_noise:
                env.unwrapped.np_random = fresh_generator(self.observation_id)
            found, action = Rollout(), self.action(control)
            for step in range(horizon):
                observation, reward, terminated, truncated, info = env.step(action)
                view = View(env.unwrapped, observation, info)
                found.observations.append(observation)
                found.rewards.append(float(reward))
                if measure is not None:
                    found.values.append(measure(view))
                    if not found.values[-1] >= least:
                        break
                found.ended = bool(terminated or truncated)
                found.reached = until is not None and until(view)
                if found.ended or found.reached:
                    break
                if policy is not None and step + 1 < horizon:
                    action = policy(view)
            return found

        return self.simulation.run(simulated)

    def margins(self, measure: Measure, horizon: int) -> Array:
        """Zeros: a rollout is what the env does."""
        return np.zeros(horizon)
