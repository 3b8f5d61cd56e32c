"""AnalyticPlant: the user's own f, g and state function, for any env with a Box action."""

from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import Array, ConfigurationError, non_negative, positive
from safe_wrappers.plants.env_checks import check_timing, refuse_second_env
from safe_wrappers.plants.plant import Plant, Trajectory


class AnalyticPlant(Plant):
    """`x' = f(x) + g(x) u` from plain functions.

    Args:
        f: x of shape (n,) to the drift, shape (n,), in state units per second.
        g: x to the control matrix, shape (n, m).
        state: The unwrapped env to x.
        control_dt: Control interval in s; None takes the env's `dt`, and an env without `dt` needs it.
        delay_s: Delay from measurement to effect in s; predicted over with the commands in flight.

    Raises:
        ConfigurationError: Shapes that do not fit, values that are not finite, a wrong or missing control interval.

    Example:
        >>> import gymnasium as gym, numpy as np, safe_wrappers as sw
        >>> plant = sw.AnalyticPlant(
        ...     f=lambda x: np.array([x[1], 2.43 * np.sin(x[0])]),  # a pendulum on the Moon: its motor is
        ...     g=lambda x: np.array([[0.0], [3.0]]),               # stronger than gravity at every angle
        ...     state=lambda env: env.state)
        >>> slow = sw.constraints.Barrier(lambda x: 4.0 - x[1] ** 2, alpha=2.0)
        >>> env = sw.CBFActionFilter(gym.make("Pendulum-v1", g=1.62), [slow], plant=plant)
    """

    state: Array = np.zeros(0)  #: shape (n,), at the last observation

    def __init__(
        self,
        f: Callable[[Array], ArrayLike],
        g: Callable[[Array], ArrayLike],
        state: Callable[[Any], ArrayLike],
        control_dt: float | None = None,
        delay_s: float = 0.0,
    ) -> None:
        for name, function in (("f", f), ("g", g), ("state", state)):
            if not callable(function):
                raise ConfigurationError(f"{name} must be a function, got {function!r}")
        self._f, self._g, self._state_of = f, g, state
        self._given_control_dt = None if control_dt is None else positive("control_dt", control_dt, "s")
        self.delay_s = non_negative("delay_s", delay_s, "s")
        self._affine: tuple[Array, Array] | None = None
        self._pending: deque[Array] = deque()

    def bind(self, env: gym.Env[Any, Any]) -> None:
        refuse_second_env(self._env, env)
        self.control_dt = check_timing(env, self._given_control_dt)
        self._pending = deque(maxlen=max(1, int(np.ceil(self.delay_s / self.control_dt - 1e-9))))
        space = env.action_space
        assert isinstance(space, gym.spaces.Box)  # the filter has refused every other space
        self.lower, self.upper = space.low.astype(np.float64), space.high.astype(np.float64)
        self._env = env

    def observe(self) -> None:
        self.observation_id += 1
        x = np.array(self._state_of(self._env.unwrapped), dtype=np.float64).reshape(-1)
        if self.delay_s > 0.0:
            x = self._after_delay(x)
        self.state, self._affine = x, None

    def executed(self, control: Array | None) -> None:
        if control is None:
            self._pending.clear()
        elif self.delay_s > 0.0:
            self._pending.append(np.array(control))

    def _after_delay(self, x: Array) -> Array:
        """Integrate over the commands in flight, the oldest first: it has acted in part already."""
        early = self.delay_s - self.control_dt * len(self._pending)
        if early > 0.0:  # before the first command of an episode no control acts
            x = self.integrate(x, np.zeros(self.lower.size), early)
        for i, control in enumerate(self._pending):
            x = self.integrate(x, control, self.control_dt + (min(early, 0.0) if i == 0 else 0.0))
        return x

    def integrate(self, x: Array, control: Array, span_s: float, substeps: int = 4) -> Array:
        """The state after a control held for `span_s`, by classical Runge-Kutta."""
        step = span_s / substeps
        for _ in range(substeps):
            k1 = self._rate(x, control)
            k2 = self._rate(x + 0.5 * step * k1, control)
            k3 = self._rate(x + 0.5 * step * k2, control)
            k4 = self._rate(x + step * k3, control)
            x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return x

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        """States half-way and at the end of a held control, by one Runge-Kutta step; the end by one Euler step.

        Raises:
            ConfigurationError: A longer horizon: nothing says what follows after the held control.
        """
        x, hold = self.state, self.control_dt
        if control is None:
            return Trajectory(None, x[None])
        if horizon > 1:
            raise ConfigurationError(
                f"an AnalyticPlant predicts one control interval and does not know how to brake after it; got a "
                f"horizon of {horizon}"
            )
        half = 0.5 * hold
        k1 = self.f + self.g @ control
        k2 = self._rate(x + half * k1, control)
        k3 = self._rate(x + half * k2, control)
        k4 = self._rate(x + hold * k3, control)
        end = x + hold / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        return Trajectory(control, np.array([x + half * k3, end, x + hold * k1]))

    def _rate(self, x: Array, control: Array) -> Array:
        return self.drift(x) + self.effect(x) @ control

    def _at_state(self) -> tuple[Array, Array]:
        """F and g at the state, checked."""
        if self._affine is None:
            self._affine = self.drift(self.state), self.effect(self.state)
            n, found = self.state.size, tuple(part.shape for part in self._affine)
            if found != ((n,), (n, self.lower.size)):
                raise ConfigurationError(
                    f"f and g must return the shapes (states,) and (states, controls) = {(n,)} and "
                    f"{(n, self.lower.size)}, got {found[0]} and {found[1]}"
                )
        return self._affine

    @property
    def f(self) -> Array:
        return self._at_state()[0]

    @property
    def g(self) -> Array:
        return self._at_state()[1]

    def drift(self, x: Array) -> Array:
        return np.asarray(self._f(x), dtype=np.float64)

    def effect(self, x: Array) -> Array:
        return np.asarray(self._g(x), dtype=np.float64)
