"""TeleopPort: where a channel meets the machine: which entries of action and observation are flow and effort."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, settings_from
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.common.layer import Env


@dataclass(frozen=True)
class TeleopPort:
    """A pair of effort and flow whose product is power; plain data.

    Args:
        flow: Entries of the action, in m/s (or rad/s).
        effort: Entries of the observation, in N (or N m), in the same order: how the command pushes the machine now.
        feedthrough: Change of the effort at once per change of the flow, N s/m: a damper before the machine.

    Raises:
        ConfigurationError: No entries, as many of the one as not of the other, or one twice.
    """

    flow: Sequence[int]
    effort: Sequence[int]
    feedthrough: float = 0.0

    def __post_init__(self) -> None:
        for name in ("flow", "effort"):
            given = getattr(self, name)
            whole = isinstance(given, Sequence) and all(
                isinstance(i, int | np.integer) and not isinstance(i, bool) and i >= 0 for i in given
            )
            if not whole or not given or len(set(given)) != len(given):
                indices = "a list of indices, each at least 0 and once"
                raise ConfigurationError(f"{name} of a port is {indices}; got {given!r}")
            object.__setattr__(self, name, [int(i) for i in given])
        if len(self.flow) != len(self.effort):
            given = f"flow {list(self.flow)} and effort {list(self.effort)}"
            raise ConfigurationError(f"a port has as many efforts as flows; got {given}")
        check_fields(self, non_negative, ["feedthrough"], "N s/m")


def port_from(given: Any, env: Env) -> TeleopPort | None:
    """A port itself, from the dict of one, or what the env publishes; None if it publishes none."""
    if given is not None:
        port = settings_from(TeleopPort, given, "port")
    elif env.has_wrapper_attr("port_flow"):
        flow, effort = (list(env.get_wrapper_attr(name)) for name in ("port_flow", "port_effort_observed"))
        port = TeleopPort(flow, effort, env.get_wrapper_attr("port_feedthrough"))
    else:
        return None
    action, observation = env.action_space, env.observation_space
    box = isinstance(observation, gym.spaces.Box) and len(observation.shape) == 1
    if not box or not np.issubdtype(observation.dtype or np.int64, np.floating):
        raise ConfigurationError(f"a port needs observations of one axis and floats, got {observation}")
    for name, indices, space in (("flow", port.flow, action), ("effort", port.effort, observation)):
        assert space.shape is not None
        if max(indices) >= space.shape[0]:
            wrong = f"{name} of the port is entry {max(indices)}"
            raise ConfigurationError(f"{wrong}, but there are only {space.shape[0]}: {space}")
    return port


class PortReading:
    """The effort at a port of an env: as observed, as foreseen, and as the env says that it acted."""

    def __init__(self, env: Env, port: TeleopPort) -> None:
        self._env, self._port = env, port
        self.feedthrough = port.feedthrough  # N s/m
        self._publishes = env.has_wrapper_attr("port_effort_acted")

    def reset(self, observation: Array) -> None:
        """At rest, the effort as observed."""
        self._last_flow = np.zeros(len(self._port.flow))
        self.effort = self.of(observation)  # at the present state and the last command, N

    @property
    def base(self) -> Array:
        """The effort without flow, N."""
        return self.effort - self.feedthrough * self._last_flow

    def acted(self, flow: Array, observation: Array) -> Array:
        """The effort during the step that was made with this flow: as the env publishes it, else as foreseen, N."""
        if self._publishes:
            acted = np.array(self._env.get_wrapper_attr("port_effort_acted"), dtype=np.float64)
        else:
            acted = self.effort + self.feedthrough * (flow - self._last_flow)
        self._last_flow = flow
        self.effort = self.of(observation)
        return acted

    def of(self, observation: Array) -> Array:
        """The effort that an observation shows, N."""
        return np.asarray(observation[self._port.effort], dtype=np.float64)

    def replaced(self, observation: Array, effort: Array) -> Array:
        """An observation that shows another effort."""
        shown = np.array(observation)
        shown[self._port.effort] = effort
        return shown
