"""Link: one direction of a network, with delay, jitter, loss and outages; and the packets in it."""

import heapq
import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from safe_wrappers.checks import check_fields, non_negative, positive, settings_from
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.common.layer import Env, WrapperRng
from safe_wrappers.wrappers.faults.kinds import OnOffProcess, probability

LONGEST_DELAY_S: Final = 10.0
"""What a line remembers, s."""


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
        ConfigurationError: A negative or too long time, a probability outside of 0 to 1, half of an outage.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    in_order: bool = True
    outage_between_s: float | None = None
    outage_length_s: float | None = None

    def __post_init__(self) -> None:
        check_fields(self, non_negative, ["delay_s", "jitter_s"], "s")
        if self.longest_s > LONGEST_DELAY_S:
            most = f"at most {LONGEST_DELAY_S:g} s"
            raise ConfigurationError(f"delay_s + jitter_s is {most}; got {self.longest_s:g} s")
        object.__setattr__(self, "loss", probability("loss", self.loss))
        if not isinstance(self.in_order, bool):
            raise ConfigurationError(f"in_order is True or False, got {self.in_order!r}")
        if (self.outage_between_s is None) != (self.outage_length_s is None):
            given = f"{self.outage_between_s!r} and {self.outage_length_s!r}"
            raise ConfigurationError(f"an outage needs outage_between_s and outage_length_s, s; got {given}")
        check_fields(self, positive, ["outage_between_s", "outage_length_s"], "s")

    @property
    def longest_s(self) -> float:
        """The longest time that a packet may take by itself, s."""
        return self.delay_s + self.jitter_s


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
    fresh: bool  # whether it arrived at the last `receive`
    late: int  # how many packets of the last `receive` were overtaken

    def reset(self, env: Env, seed: int | None, first: Any = None) -> None:
        """Nothing is on its way, and `first` has arrived; call it after the env's own reset."""
        self._random.reset(env, seed)
        if self._outages is not None:
            self._outages.begin(self._random)
        self._coming: list[tuple[float, int, Any]] = []
        self._sent = 0
        self._latest_s = -math.inf
        self.newest, self.fresh, self.late = Packet(-1, first), False, 0

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
        before = self.newest.sequence
        self.newest = max([self.newest, *found], key=lambda packet: packet.sequence)
        self.fresh = self.newest.sequence > before
        self.late = len(found) - self.fresh
        return found
