"""What a `TeleopChannel` is made of: links, ports, the ceiling on the round trip."""

import heapq
import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive, settings_from, true_or_false
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.faults import OnOffProcess, probability
from safe_wrappers.wrappers.layer import Env, WrapperRng
from safe_wrappers.wrappers.stopping_budget import BoundBudget, BudgetLike, budget_from

__all__ = ["Link", "RoundTripCeiling"]

_RELEASE: Final = 0.8
"""Authority comes back only when the round trip is below this share of the ceiling."""


@dataclass(frozen=True)
class Link:
    """What a network does to packets in one direction; plain data.

    Args:
        delay_s: Shortest time that a packet takes, s.
        jitter_s: How much longer it may take, s, uniform, drawn for each packet by itself.
        loss: Probability that a packet is lost, from 0 to 1; during an outage every one is.
        in_order: Whether a packet waits for those sent before it, as in a stream; datagrams may overtake (False).
        outage_between_s: Mean time from the end of an outage to the start of the next, s; None: there are none.
        outage_length_s: Mean length of an outage, s.

    Raises:
        ConfigurationError: A negative time, a probability outside of 0 to 1, half of an outage.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    in_order: bool = True
    outage_between_s: float | None = None
    outage_length_s: float | None = None

    def __post_init__(self) -> None:
        check_fields(self, non_negative, ["delay_s", "jitter_s"], "s")
        object.__setattr__(self, "loss", probability("loss", self.loss))
        true_or_false("in_order", self.in_order)
        if (self.outage_between_s is None) != (self.outage_length_s is None):
            given = f"{self.outage_between_s!r} and {self.outage_length_s!r}"
            raise ConfigurationError(f"an outage needs outage_between_s and outage_length_s, s; got {given}")
        check_fields(self, positive, ["outage_between_s", "outage_length_s"], "s")


def link_from(name: str, given: Any) -> Link:
    """A link itself, from the dict of one, or with that number of seconds as its delay."""
    if isinstance(given, int | float) and not isinstance(given, bool):
        return Link(delay_s=given)
    return settings_from(Link, given, name, ", or a delay in s")


class Packet(NamedTuple):
    """A packet, by its number on the line (from 0), which packets compare by, and what it carries."""

    sequence: int
    load: Any


class Line:
    """The packets of one direction, with random numbers of their own; times closer than `slack_s` are the same."""

    def __init__(self, link: Link, stream: str, slack_s: float) -> None:
        self._link, self._slack_s = link, slack_s
        self._random = WrapperRng(stream)
        between_s, length_s = link.outage_between_s, link.outage_length_s
        self._outages = None if between_s is None or length_s is None else OnOffProcess(between_s, length_s)

    newest: Packet  # of all that have arrived the one that was sent last

    def reset(self, env: Env, seed: int | None, first: Any = None) -> None:
        """Nothing is on its way, and `first` has arrived; call it after the env's own reset."""
        self._random.reset(env, seed)
        if self._outages is not None:
            self._outages.begin(self._random)
        self._coming: list[tuple[float, int, Any]] = []
        self._sent = 0
        self._latest_s = -math.inf
        self.newest = Packet(-1, first)

    def send(self, load: Any, now_s: float) -> tuple[int, bool]:
        """Send something; its number, and whether it gets lost."""
        link, sequence = self._link, self._sent
        self._sent += 1
        # As many numbers for a lost packet as for one that is not: what follows stays the same.
        jitter_s = self._random.draw.uniform(0.0, link.jitter_s) if link.jitter_s else 0.0
        lost = bool(link.loss and self._random.draw.random() < link.loss)
        if self._outages is not None:
            lost |= self._outages.is_on(now_s, self._random)
        if lost:
            return sequence, True
        due_s = now_s + link.delay_s + jitter_s
        if link.in_order:
            due_s = self._latest_s = max(due_s, self._latest_s)
        heapq.heappush(self._coming, (due_s, sequence, load))
        return sequence, False

    def receive(self, now_s: float) -> list[Packet]:
        """What has arrived since the last call, in the order of arrival."""
        found: list[Packet] = []
        while self._coming and self._coming[0][0] <= now_s + self._slack_s:
            _, sequence, load = heapq.heappop(self._coming)
            found.append(Packet(sequence, load))
        self.newest = max([self.newest, *found], key=lambda packet: packet.sequence)
        return found


class Port(NamedTuple):
    """A pair of effort and flow whose product is power, as an env publishes it."""

    flow: list[int]  # entries of the action, in m/s (or rad/s)
    effort: list[int]  # entries of the observation, in N (or N m): how the command pushes the machine now
    feedthrough: (
        float  # change of the effort at once per change of the flow, N s/m: a damper before the machine
    )


def port_of(env: Env) -> Port | None:
    """What the env publishes; None if it publishes nothing."""
    if not env.has_wrapper_attr("port_flow"):
        return None
    flow, effort = (list(env.get_wrapper_attr(name)) for name in ("port_flow", "port_effort_observed"))
    action, observation = env.action_space, env.observation_space
    box = isinstance(observation, gym.spaces.Box) and len(observation.shape) == 1
    if not box or not np.issubdtype(observation.dtype or np.int64, np.floating):
        raise ConfigurationError(f"a port needs observations of one axis and floats, got {observation}")
    assert action.shape is not None and observation.shape is not None
    if len(flow) != len(effort) or max(flow) >= action.shape[0] or max(effort) >= observation.shape[0]:
        entries = f"flow {flow} and effort {effort}"
        raise ConfigurationError(f"no port of {action} and {observation} has {entries}")
    return Port(flow, effort, float(env.get_wrapper_attr("port_feedthrough")))


class PortReading:
    """The effort at the port of an env: as observed, and as the env says that it acted."""

    def __init__(self, env: Env, port: Port) -> None:
        self._env, self._port = env, port
        self.feedthrough = port.feedthrough  # N s/m

    def reset(self, observation: Array) -> None:
        """At rest, the effort as observed."""
        self._last_flow = np.zeros(len(self._port.flow))
        self.effort = self.of(observation)  # at the present state and the last command, N

    @property
    def base(self) -> Array:
        """The effort without flow, N."""
        return self.effort - self.feedthrough * self._last_flow

    def acted(self, flow: Array, observation: Array) -> Array:
        """The effort during the step that was made with this flow, as the env publishes it, N."""
        self._last_flow = flow
        self.effort = self.of(observation)
        return np.array(self._env.get_wrapper_attr("port_effort_acted"), dtype=np.float64)

    def of(self, observation: Array) -> Array:
        """The effort that an observation shows, N."""
        return np.asarray(observation[self._port.effort], dtype=np.float64)

    def replaced(self, observation: Array, effort: Array) -> Array:
        """An observation that shows another effort."""
        shown = np.array(observation)
        shown[self._port.effort] = effort
        return shown


@dataclass(frozen=True)
class RoundTripCeiling:
    """The longest round trip at which an operator may still be relied on, from the clearance and speed of the moment.

    See `control.watchdog`. A command after which the machine could not stop is refused.

    Args:
        budget: A `StoppingBudget` or the dict of one, whose clearance is a `Clearance` or a function of the env.
        video_s: T_video, exposure, encoding and display, without the downlink, s.
        human_s: T_human, the operator's reaction, s.
        longest_s: No ceiling is higher, s: an operator who is silent for longer loses authority at rest, too.

    Raises:
        ConfigurationError: A time that cannot be, or a clearance that measures no approach.
    """

    budget: BudgetLike
    _: KW_ONLY
    video_s: float = 0.1
    human_s: float = 0.25
    longest_s: float = 1.0

    def __post_init__(self) -> None:
        budget = budget_from(self.budget)
        if not budget.measures_approach:
            name = type(budget.clearance).__name__
            raise ConfigurationError(f"{name} does not say how fast it is approached: give a Clearance")
        object.__setattr__(self, "budget", budget)
        check_fields(self, non_negative, ["video_s", "human_s"], "s")
        check_fields(self, positive, ["longest_s"], "s")


class RoundTripWatch:
    """Measures clearance and approach, and decides whether the operator is obeyed in the coming control step."""

    budget: BoundBudget  # to be bound to a plant
    revoked: bool  # whether authority is revoked, as `judge` left it
    readable: bool  # whether clearance and speed were finite when `look` was called
    ceiling_s: float  # the longest round trip then, s, within `longest_s` of 0; the lowest where unreadable

    def __init__(self, env: Env, ceiling: RoundTripCeiling, control_dt: float, slack_s: float = 0.0) -> None:
        self._ceiling, self._control_dt, self._slack_s = ceiling, control_dt, slack_s
        self.budget = BoundBudget(budget_from(ceiling.budget), env)

    def reset(self) -> None:
        """A new episode: authority is the operator's."""
        self.budget.reset()
        self.revoked, self._revoked_s = False, -math.inf
        self.look()

    def look(self) -> None:
        """Measure the clearance of the present state."""
        ceiling, budget = self._ceiling, self.budget
        budget.measure()
        self.readable = budget.readable
        if not self.readable:
            self.ceiling_s = -ceiling.longest_s
            return
        # The next look comes one control step from now.
        highest_s = budget.longest_round_trip(ceiling.video_s, ceiling.human_s) - self._control_dt
        self.ceiling_s = min(max(highest_s, -ceiling.longest_s), ceiling.longest_s)

    def judge(self, command: Array, seen_s: float, round_trip_s: float, now_s: float) -> None:
        """Revoke authority, or give it back, for a command (m,) made from the image that was taken at `seen_s`."""
        allowed_s = self.ceiling_s
        if self.revoked and allowed_s > 0.0:
            allowed_s *= _RELEASE
        trusted = self.readable and round_trip_s <= allowed_s + self._slack_s
        if self.revoked:
            trusted = trusted and seen_s >= self._revoked_s - self._slack_s
        trusted = trusted and self.budget.can_stop_after(command, self._control_dt)
        if not trusted and not self.revoked:
            self._revoked_s = now_s
        self.revoked = not trusted
