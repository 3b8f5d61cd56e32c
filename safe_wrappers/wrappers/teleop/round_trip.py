"""RoundTripCeiling: the longest round trip of a remote operator; and the watch that revokes authority above it."""

import math
from dataclasses import KW_ONLY, dataclass

from safe_wrappers.checks import Array, check_fields, non_negative, positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.common.layer import Env
from safe_wrappers.wrappers.lease.stopping_budget import BoundBudget, BudgetLike, budget_from


@dataclass(frozen=True)
class RoundTripCeiling:
    """The longest round trip at which an operator may still be relied on, from the clearance and speed of the moment.

    See `control.watchdog.leases.round_trip_ceiling`. A command after which the machine could not stop is refused.

    Args:
        budget: A `StoppingBudget` or the dict of one, whose clearance is a `Clearance` or a function of the env.
        video_s: T_video, exposure, encoding and display, without the downlink, s.
        human_s: T_human, the operator's reaction, s.
        longest_s: No ceiling is higher, s: an operator who is silent for longer loses authority at rest, too.
        release: Authority comes back only when the round trip is below this share of the ceiling.

    Raises:
        ConfigurationError: A time or share that cannot be, or a clearance that measures no approach.
    """

    budget: BudgetLike
    _: KW_ONLY
    video_s: float = 0.1
    human_s: float = 0.25
    longest_s: float = 1.0
    release: float = 0.8

    def __post_init__(self) -> None:
        budget = budget_from(self.budget)
        if not budget.measures_approach:
            name = type(budget.clearance).__name__
            raise ConfigurationError(f"{name} does not say how fast it is approached: give a Clearance")
        object.__setattr__(self, "budget", budget)
        check_fields(self, non_negative, ["video_s", "human_s"], "s")
        check_fields(self, positive, ["longest_s"], "s")
        check_fields(self, positive, ["release"], "a share of the ceiling")
        if self.release > 1.0:
            raise ConfigurationError(f"release is a share of the ceiling, at most 1; got {self.release}")


class RoundTripWatch:
    """Measures clearance and approach, and decides whether the operator is obeyed in the coming control step."""

    budget: BoundBudget  # to be bound to a plant
    revoked: bool  # whether authority is revoked, as `judge` left it
    readable: bool  # whether clearance and speed were finite when `look` was called
    clearance_m: float  # the smallest clearance then, m; inf where nothing is near, 0 where unreadable
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
            self.clearance_m, self.ceiling_s = 0.0, -ceiling.longest_s
            return
        self.clearance_m = float(budget.clearance.min(initial=math.inf))
        # The next look comes one control step from now.
        highest_s = budget.longest_round_trip(ceiling.video_s, ceiling.human_s) - self._control_dt
        self.ceiling_s = min(max(highest_s, -ceiling.longest_s), ceiling.longest_s)

    def judge(self, command: Array, seen_s: float, round_trip_s: float, now_s: float) -> None:
        """Revoke authority, or give it back, for a command (m,) made from the image that was taken at `seen_s`."""
        allowed_s = self.ceiling_s
        if self.revoked and allowed_s > 0.0:
            allowed_s *= self._ceiling.release
        trusted = self.readable and round_trip_s <= allowed_s + self._slack_s
        if self.revoked:
            trusted = trusted and seen_s >= self._revoked_s - self._slack_s
        trusted = trusted and self.budget.can_stop_after(command, self._control_dt)
        if not trusted and not self.revoked:
            self._revoked_s = now_s
        self.revoked = not trusted
