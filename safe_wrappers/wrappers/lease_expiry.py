"""LeaseExpiry: a command is in force only while the machine could still stop behind it."""

import math
from typing import Any, ClassVar

from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control.handover import Fade
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    non_negative,
    positive,
    settings_from,
)
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants import own_plant
from safe_wrappers.plants.env_checks import refuse_changed_actions
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.layer import Env, Step, action_array, whole_steps
from safe_wrappers.wrappers.stack import Layer
from safe_wrappers.wrappers.stopping import (
    BoundBudget,
    CommandGate,
    FallbackController,
    StoppingBudget,
    bound_plant,
)


class LeaseExpiry(CommandGate):
    """Grants every fresh command a lease, and brakes when nothing fresh has come before it runs out.

    A lease is as long as the machine, driven on by the command at its worst, could still stop inside the clearance of
    the moment (`StoppingBudget`). A command is fresh if its observation is newer than that of the command in force
    (`set_observation_time`). One of the same observation is executed under the old lease; one that is older, from the
    future or not finite is refused.

    **What it guarantees.** If all bounds are what they are declared to be and the clearance does not shrink by
    itself, the machine stops inside it whenever commands stop coming, whatever the commands did. While leases last,
    commands in the action space pass bit for bit. **What it does not.** It does not check what a fresh command does;
    `CBFActionFilter` belongs inside.

    Args:
        env: With a one-dimensional Box action space.
        budget: A `StoppingBudget` or the dict of one.
        max_lease_s: No lease is longer, s.
        min_lease_s: Every fresh command gets a lease of at least so long, s; above 0 only with a CBFActionFilter
            inside. Behind a `ChunkHandover` give the time of one `execution_horizon`.
        blend_time: s, of the way back from the fallback to a fresh command.
        fallback: "brake", "hold", "zero", or a function of the plant.
        plant: For the constraint and the fallback; None reads the env's MuJoCo model.

    Info, at every step: ``lease/remaining_s`` (float), ``lease/refused``, ``lease/braking`` (bool); without a filter
    inside ``executed_action`` and ``action/clipped`` (float).

    Raises:
        ConfigurationError: A missing or negative bound or time, a clearance that is neither, or a wrong order.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
        >>> clearance = sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0)
        >>> budget = sw.StoppingBudget(clearance, acceleration=30.0)
        >>> env = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), budget)
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> info["lease/braking"], info["lease/remaining_s"] > 0.0
        (False, True)
    """

    layer: ClassVar = Layer.LEASE

    _fallback: FallbackController

    def __init__(
        self,
        env: Env,
        budget: StoppingBudget | dict[str, Any],
        *,
        max_lease_s: float = 1.0,
        min_lease_s: float = 0.0,
        blend_time: float = 0.1,
        fallback: str | FallbackFunction = "brake",
        plant: Plant | None = None,
    ) -> None:
        CommandGate.__init__(self, env)
        refuse_changed_actions(env)
        plant, budget = own_plant(plant), settings_from(StoppingBudget, budget, "budget")
        self._max_lease_s = positive("max_lease_s", max_lease_s, "s")
        self._min_lease_s = non_negative("min_lease_s", min_lease_s, "s")
        if self._max_lease_s < max(self.control_dt - self._same_s, self._min_lease_s):
            raise ConfigurationError(
                f"max_lease_s = {max_lease_s} s is less than one control step or than min_lease_s = {min_lease_s} s"
            )
        if self._min_lease_s > 0.0 and not self._filtered:
            raise ConfigurationError(
                "min_lease_s above 0 needs a CBFActionFilter inside: LeaseExpiry(sw.protect(env), ...)"
            )
        self._blend_steps = whole_steps(non_negative("blend_time", blend_time, "s"), self.control_dt)
        plant = bound_plant(env, plant, fallback, budget.clearance)
        self._budget = BoundBudget(budget, env, plant)
        self._fallback = FallbackController(env, fallback, plant, self._budget.bound)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._until_s = self._newest_s = -math.inf
        self._command = self._rest()
        self._executed: Array | None = None
        self._braking = False
        self._fade = Fade()
        self._budget.observe()
        info[keys.LEASE_REMAINING_S] = 0.0
        info[keys.LEASE_REFUSED] = info[keys.LEASE_BRAKING] = False
        return super()._begin(observation, info, seed)

    def step(self, action: Any) -> Step:
        """Execute the action under its lease, the command in force under its own, or the fallback."""
        self._refuse_without_reset()
        given = self._inside(action_array(action, self._shape))
        now = self.now_s
        command, refused = self._accepted(given, now)
        covered = now + self.control_dt <= self._until_s + self._same_s
        if covered:
            self._command = self._command if command is None else command
            if self._braking and self._executed is not None:
                self._fade = Fade(self._boxed(self._executed), self._blend_steps)
            # The env gets a copy as well: it may scale in place what is still in force. A fade stays in the box, so
            # that rounding makes no infinity of anything.
            faded = None if self._fade.over else self._fade(self._boxed(self._command)).astype(self._dtype)
            sent = self._command.copy() if faded is None else faded
        else:
            self._fade = Fade()
            sent = self._fallback.command().astype(self._dtype)
        self._braking = not covered
        self._executed, answer = self._execute(sent)
        self._observed_s = self.now_s
        info = answer[4]
        info[keys.LEASE_REMAINING_S] = max(self._until_s - self.now_s, 0.0)
        info[keys.LEASE_REFUSED] = refused
        info[keys.LEASE_BRAKING] = not covered
        return answer

    def _accepted(self, given: NDArray[Any] | None, now: float) -> tuple[NDArray[Any] | None, bool]:
        """The command that may be executed, if there is one; whether one was refused. A fresh one gets a lease."""
        observed_s = self._observed_s
        if observed_s is None:
            return None, False
        from_future = observed_s > now + self._same_s
        if given is None or from_future or observed_s < self._newest_s - self._same_s:
            return None, True
        if observed_s > self._newest_s + self._same_s:
            self._newest_s = observed_s
            return given, not self._grant(now)
        return given, False

    def _grant(self, now: float) -> bool:
        """A new lease for the fresh command; False, and none at all, where it would not last."""
        self._budget.measure()
        # A step may outlast its lease by what counts as the same time.
        longest_s = self._budget.longest_time(self._same_s + max(now - self._newest_s, 0.0))
        lease = max(min(longest_s, self._max_lease_s), self._min_lease_s)
        # NaN gives no lease at all: a filter inside reads the same state.
        granted = not math.isnan(longest_s) and lease + self._same_s >= self.control_dt
        self._until_s = now + lease if granted else -math.inf
        return granted
