"""LeaseExpiry: a command is in force only while the machine could still stop behind it."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, non_negative, positive
from safe_wrappers.control.handover import smoothstep
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants import own_plant
from safe_wrappers.plants.env_checks import refuse_changed_actions
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import plain_data
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.admission import Admission
from safe_wrappers.wrappers.commands import CommandGate, FallbackController
from safe_wrappers.wrappers.layer import Env, Reset, Step, action_array, whole_steps
from safe_wrappers.wrappers.stopping_budget import BoundBudget, BudgetLike, budget_from


class LeaseExpiry(CommandGate):
    """Grants every fresh command a lease, and brakes when nothing fresh has come before it runs out.

    A lease is as long as the machine, driven on by the command at its worst, could still stop inside the clearance of
    the moment (`StoppingBudget`). A command is fresh if its observation is newer than that of the command in force
    (`set_observation_time`). One of the same observation is executed under the old lease; one that is older, from the
    future or not finite is refused.

    **What it guarantees.** If braking, acceleration, delays and bounds are what they are declared to be and the
    clearance does not shrink by itself, the machine stops inside it whenever commands stop coming, whatever the
    commands did. While leases last, commands in the action space pass bit for bit. **What it does not.** It does not
    check what a fresh command does; `CBFActionFilter` belongs inside. Close to an obstacle no command gets a lease.

    Args:
        env: With a one-dimensional Box action space.
        budget: A `StoppingBudget` or the dict of one.
        detect_s: T_detect, s, until the end of a lease is recognised.
        confirm_s: T_hold, s, a window of confirmation in which the last command goes on.
        age_s: t_age, s, of the clearance when it is read.
        max_lease_s: No lease is longer, s.
        min_lease_s: Every fresh command gets a lease of at least so long, s; above 0 only with a CBFActionFilter
            inside. Behind a `ChunkHandover` give the time of one `execution_horizon`.
        blend_time: s, of the way back from the fallback to a fresh command.
        motion_limits: For actions that are setpoints of the lengths of MuJoCo's actuators: {"max_acceleration": ...,
            "max_speed": ..., "arrival": "moving" or "rest"}; chunks whose end is out of reach are refused.
        fallback: "brake", "hold", "zero", or a function of the plant.
        plant: For the constraint and the fallback; None reads the env's MuJoCo model.
        control_dt: Control interval, s; None reads the env's `dt`.

    Info, at every step: ``lease/remaining_s`` (float), ``lease/refused``, ``lease/braking``
    (bool); without a filter inside ``executed_action`` and ``action/clipped`` (float).

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
    _executed: Array | None
    _blend: tuple[Array, int] | None

    def __init__(
        self,
        env: Env,
        budget: BudgetLike,
        *,
        detect_s: float = 0.0,
        confirm_s: float = 0.0,
        age_s: float = 0.0,
        max_lease_s: float = 1.0,
        min_lease_s: float = 0.0,
        blend_time: float = 0.1,
        motion_limits: Mapping[str, Any] | None = None,
        fallback: str | FallbackFunction = "brake",
        plant: Plant | None = None,
        control_dt: float | None = None,
    ) -> None:
        arguments = dict(locals())
        CommandGate.__init__(self, env, control_dt)
        refuse_changed_actions(env)
        plant, budget = own_plant(plant), budget_from(budget)
        limits = dict(motion_limits) if isinstance(motion_limits, Mapping) else motion_limits
        self._record(arguments, budget=plain_data(budget), motion_limits=limits, plant=plant)
        self._max_lease_s = positive("max_lease_s", max_lease_s, "s")
        if self._max_lease_s < self.control_dt - self._same_s:
            step = f"one control step, {self.control_dt} s"
            raise ConfigurationError(f"max_lease_s = {max_lease_s} s is less than {step}")
        self._min_lease_s = non_negative("min_lease_s", min_lease_s, "s")
        if self._min_lease_s > self._max_lease_s:
            raise ConfigurationError(f"min_lease_s = {min_lease_s} s is above max_lease_s = {max_lease_s} s")
        if self._min_lease_s > 0.0 and not self._filtered:
            example = "LeaseExpiry(sw.protect(env), ...)"
            raise ConfigurationError(f"min_lease_s above 0 needs a CBFActionFilter inside: {example}")
        self._blend_steps = whole_steps(non_negative("blend_time", blend_time, "s"), self.control_dt)
        delays = {"detect_s": detect_s, "confirm_s": confirm_s, "age_s": age_s}
        detect, confirm, age = (non_negative(name, value, "s") for name, value in delays.items())
        self._delays_s = detect + confirm + age + self._same_s  # by which a step may outlast its lease
        self._budget = BoundBudget(budget, env)
        plant = self._budget.plant_of(plant)
        self._fallback = FallbackController(env, fallback, plant, self._budget.constraint)
        self._budget.bind(plant, self._fallback.constraint)
        self._admission = None if motion_limits is None else Admission(env, motion_limits, self._low.size)
        self._start({})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env; no command is in force."""
        self.started = False
        observation, info = self.env.reset(seed=seed, options=options)
        self._fallback.reset()
        self._budget.reset()
        self._start(info)
        info[keys.LEASE_REMAINING_S] = 0.0
        info.update(dict.fromkeys((keys.LEASE_REFUSED, keys.LEASE_BRAKING), False))
        self.started = True
        return observation, info

    def _start(self, info: dict[str, Any]) -> None:
        super()._start(info)
        self._until_s = self._newest_s = -math.inf
        self._command = self._rest()
        self._executed = None
        self._braking = self._chunk_refused = False
        self._blend = None

    def step(self, action: Any) -> Step:
        """Execute the action under its lease, the command in force under its own, or the fallback."""
        self._refuse_without_reset()
        given = self._inside(action_array(action, self._shape), "policy's")
        now = self.now_s
        arrived, fresh, refused = self._accept(given, now)
        if fresh:
            refused |= not self._grant(now)
        covered = now + self.control_dt <= self._until_s + self._same_s
        if covered:
            if arrived:
                self._command = given
            if self._braking:
                self._braking, self._blend = False, self._start_blend()
            # The env gets a copy as well: it may scale in place what is still in force.
            sent = self._command.copy() if self._blend is None else self._blended(self._command)
        else:
            self._braking, self._blend = True, None
            sent = self._fallback.command().astype(self._dtype)
        self._executed, answer = self._execute(sent)
        self._observed_s = self.now_s
        info = answer[4]
        info[keys.LEASE_REMAINING_S] = max(self._until_s - self.now_s, 0.0)
        info[keys.LEASE_REFUSED] = refused
        info[keys.LEASE_BRAKING] = not covered
        return answer

    def admits(self, end: Array, steps: int) -> bool:
        """Whether the end of a chunk of setpoints is within `motion_limits`; a refusal is in the next step's info."""
        admitted = self._admission is None or self._admission.admits(end, steps * self.control_dt)
        self._chunk_refused |= not admitted
        return admitted

    def _accept(self, command: NDArray[Any], now: float) -> tuple[bool, bool, bool]:
        """Whether there is a command that may be executed, whether it is a fresh one, whether one was refused."""
        observed_s, refused, newest_s = self._observed_s, self._chunk_refused, self._newest_s
        self._chunk_refused = False
        if observed_s is None:
            return False, False, refused
        from_future = observed_s > now + self._same_s
        finite = self._is_finite(command, "policy's", "the command in force goes on under its lease")
        if from_future or observed_s < newest_s - self._same_s or not finite:
            return False, False, True
        fresh = observed_s > newest_s + self._same_s
        if fresh:
            self._newest_s = observed_s
        return True, fresh, refused

    def _grant(self, now: float) -> bool:
        """A new lease for the fresh command; False, and none at all, where it would not last."""
        self._budget.measure()
        longest_s = self._budget.longest_time(self._delays_s + max(now - self._newest_s, 0.0))
        lease = max(min(longest_s, self._max_lease_s), self._min_lease_s)
        # NaN gives no lease at all: a filter inside reads the same state.
        granted = not math.isnan(longest_s) and lease + self._same_s >= self.control_dt
        self._until_s = now + lease if granted else -math.inf
        return granted

    def _start_blend(self) -> tuple[Array, int] | None:
        """From what was executed last, and how many steps of the blend are done; None where there is nothing to."""
        if self._executed is None or self._blend_steps == 0:
            return None
        return self._boxed(self._executed), 0

    def _blended(self, target: Any) -> Any:
        """In the box, so that rounding to its dtype makes no infinity of anything."""
        assert self._blend is not None
        start, done = self._blend
        weight = float(smoothstep((done + 1.0) / (self._blend_steps + 1.0)))
        self._blend = (start, done + 1) if done + 1 < self._blend_steps else None
        return (start * (1.0 - weight) + weight * self._boxed(target)).astype(self._dtype)
