"""LeaseExpiry: a command is in force only as long as the machine could still stop behind it."""

import math
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, Final, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control.handover.smoothstep import smoothstep
from safe_wrappers.control.watchdog.leases import LeaseDelays
from safe_wrappers.errors import ActionError, ConfigurationError
from safe_wrappers.filter.constraint import Constraint, non_negative, positive
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.default import default_plant
from safe_wrappers.plants.plant import Plant, check_actions, check_timing, refuse_changed_actions, wrappers_of
from safe_wrappers.plants.template import PlantOfSpec, own_plant
from safe_wrappers.serialize import constraint_data
from safe_wrappers.stack import Layer, refuse_order
from safe_wrappers.wrappers.cbf_action_filter import is_filtered
from safe_wrappers.wrappers.common.fallback_controller import StandIn
from safe_wrappers.wrappers.common.receiver import CommandReceiver
from safe_wrappers.wrappers.lease.admission import Admission, Measured
from safe_wrappers.wrappers.lease.room import ClearanceFunction, Room

Array = NDArray[np.float64]

_SAME_TIME: Final = 1e-6
"""Control steps: times that are closer are meant to be the same."""


class LeaseExpiry(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs, CommandReceiver):
    """Grants every fresh command a lease, and brakes when nothing fresh has come before it runs out.

    A lease is as long as the machine, driven on by the command at its worst and told nothing more, could still stop
    inside the clearance of the moment:

        way(lease + detect + confirm + age + act) + v^2 / (2 braking) + localisation + margin <= clearance

    (`control/watchdog/leases.py`; the way at the approach speed v, growing by `acceleration`). It is granted when a
    fresh command comes, and counted down on the clock of control steps: no clearance is read in between, as a
    watchdog could not. While nothing fresh comes, the command in force goes on: repeated if it is a single one, step
    by step if it is a chunk's (`ChunkHandover` outside). A control step is executed only if the lease covers all of
    it. When it does not, or where a fresh command would get no lease for a whole step, the fallback brakes at once.
    Authority comes back with a fresh command alone, over a blend of `blend_time`; a lease that ends on the way back
    brakes at once, too.

    **What is fresh.** Without a word every action is made from the newest observation. A wrapper outside may
    `deliver` the time of the observation instead, or None for nothing; `ChunkHandover` does, and so do the faults of
    `safe_wrappers.wrappers.faults`. A command that is not newer than the one in force (a frozen policy, a repeated
    chunk) is executed under the old lease, an older one or one from the future is refused. The age of a command
    counts in its lease. A command that is not finite counts as none.

    **What it guarantees.** If braking, acceleration, delays and bounds are what they are declared to be and the
    clearance does not shrink by itself, the machine stops inside it whenever commands stop coming, whatever the
    commands did. No command that is not finite passes. With leases left the commands pass bit for bit.

    **Close to an obstacle** the worst command would use up the room within one control step: there no command gets a
    lease, the one that leads away neither. With a `CBFActionFilter` inside, which admits only what is safe for the
    next step, `least_s` of one control step lets every fresh command through to it; the lease then only ends stale
    ones. Behind a `ChunkHandover` a fresh command comes once per `execution_horizon`: give `least_s` that time, or
    brake and chunks take turns.

    **What it does not.** It does not look at what a fresh command does: a policy that lives may drive into the
    obstacle until the clearance is too small for a lease of one control step; then it brakes. Obstacles that come
    closer by themselves must be in the approach speed. `CBFActionFilter` belongs inside.

    Args:
        env: With a one-dimensional Box action space.
        clearance: A `Clearance`; any other constraint, with `closing_speed`; or a function of the env that returns
            clearances in m and approach speeds in m/s.
        braking: Verified lower bound on the deceleration of the fallback, m/s^2; a Clearance brings its own.
        acceleration: Largest approach acceleration that any command may cause, m/s^2; 0 for a machine that cruises.
            The fallback's commands count too: braking a machine that recedes pushes it towards the obstacle.
        closing_speed: For constraints other than Clearance: the fastest that their value may fall, per second.
        top_speed: Bound on the approach speed, m/s.
        detect_s: T_detect, s, until the end of a lease is recognised.
        confirm_s: T_hold, s, a window of confirmation in which the last command goes on.
        age_s: t_age, s, of the clearance when it is read.
        act_s: T_act, s, until the full deceleration is there.
        localisation: Bound on the error of the clearance, m.
        margin: Clearance to be kept at rest, m; a constraint's own is added.
        longest_s: No lease is longer, s, however large the clearance.
        least_s: Every fresh command gets a lease of at least so long, s; above 0 only with a CBFActionFilter inside.
        blend_time: s, of the way back from the fallback to a fresh command.
        brake_blend_time: s, of the way to the fallback; it counts in the budget. 0: at once.
        clock_error_s: Bound on how wrong the stamps of commands may be, s; it counts in the budget.
        reach: Limits on the motion, {"max_acceleration": ..., "max_speed": ..., "max_jerk": ..., "arrival": "moving"
            or "rest"}, for actions that are position setpoints: `ChunkHandover` then has a chunk refused whose end is
            out of reach in its time (`wrappers/lease/admission.py`).
        measured: For `reach`: a function of the env that returns positions, velocities and, for an arrival at rest
            with limited jerk, accelerations; None reads the lengths of the MuJoCo actuators.
        fallback: "brake", "hold", "zero", or a function of the plant.
        plant: For the constraint and the fallback; None reads the env's MuJoCo model.
        hold_s: Control interval, s; None reads the env's `dt`.

    Info, at every step: ``lease/remaining_s`` (float), ``lease/expired``, ``lease/refused``, ``lease/braking``
    (bool).

    Raises:
        ConfigurationError: A missing or negative bound or time, a clearance that is neither, or a wrong order.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> rail = [sw.Plane([-0.9], [1]), sw.Plane([0.9], [-1])]
        >>> clearance = sw.Clearance(rail, bodies=["cart"], braking=8.0)
        >>> env = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), clearance, acceleration=30.0)
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> info["lease/braking"], info["lease/remaining_s"] > 0.0
        (False, True)

    Change log:
        * v0.1.0: added.
    """

    layer: ClassVar = Layer.LEASE

    _until_s: float
    _newest_s: float
    _evidence: float | None
    _executed: Array | None
    _braking: bool
    _chunk_refused: bool
    _fade: tuple[Array, int, int] | None

    def __init__(
        self,
        env: gym.Env[Any, Any],
        clearance: Constraint | dict[str, Any] | ClearanceFunction,
        braking: float | None = None,
        acceleration: float | None = None,
        closing_speed: float | None = None,
        top_speed: float | None = None,
        detect_s: float = 0.0,
        confirm_s: float = 0.0,
        age_s: float = 0.0,
        act_s: float = 0.0,
        localisation: float = 0.0,
        margin: float = 0.0,
        longest_s: float = 1.0,
        least_s: float = 0.0,
        blend_time: float = 0.1,
        brake_blend_time: float = 0.0,
        clock_error_s: float = 0.0,
        reach: Mapping[str, Any] | None = None,
        measured: Measured | None = None,
        fallback: str | FallbackFunction = "brake",
        plant: Plant | None = None,
        hold_s: float | None = None,
    ) -> None:
        refuse_order(env, self.layer, type(self).__name__)
        space = check_actions(env)
        refuse_changed_actions(env)
        plant = own_plant(plant)
        self._room = Room(
            env,
            clearance,
            braking=braking,
            acceleration=acceleration,
            closing_speed=closing_speed,
            top_speed=top_speed,
            localisation=localisation,
            margin=margin,
        )
        constraint = self._room.constraint
        gym.utils.RecordConstructorArgs.__init__(
            self,
            clearance=clearance if constraint is None else constraint_data(constraint),
            braking=braking,
            acceleration=acceleration,
            closing_speed=closing_speed,
            top_speed=top_speed,
            detect_s=detect_s,
            confirm_s=confirm_s,
            age_s=age_s,
            act_s=act_s,
            localisation=localisation,
            margin=margin,
            longest_s=longest_s,
            least_s=least_s,
            blend_time=blend_time,
            brake_blend_time=brake_blend_time,
            clock_error_s=clock_error_s,
            reach=dict(reach) if isinstance(reach, Mapping) else reach,
            measured=measured,
            fallback=fallback,
            plant=None if plant is None else PlantOfSpec(plant),
            hold_s=hold_s,
        )
        gym.Wrapper.__init__(self, env)
        self.hold_s = check_timing(env, hold_s)
        self._longest_s = positive("longest_s", longest_s, "s")
        if self._longest_s < (1.0 - _SAME_TIME) * self.hold_s:
            raise ConfigurationError(
                f"longest_s = {longest_s} s is less than one control step, {self.hold_s} s: no command would ever be "
                "executed"
            )
        self._least_s = _least(env, least_s, self._longest_s)
        self._blend_steps = self._steps("blend_time", blend_time)
        self._brake_steps = self._steps("brake_blend_time", brake_blend_time)
        self._clock_error_s = non_negative("clock_error_s", clock_error_s, "s")
        delays = {"detect_s": detect_s, "confirm_s": confirm_s, "age_s": age_s, "act_s": act_s}
        of_formula = [non_negative(name, value, "s") for name, value in delays.items()]
        self._delays_s = (
            LeaseDelays(*of_formula).total_s + self._brake_steps * self.hold_s + self._clock_error_s
        )
        self._delays_s += _SAME_TIME * self.hold_s  # what a step may last beyond its lease
        if plant is None and constraint is not None:
            plant = default_plant(env)
        backups = [constraint] if hasattr(constraint, "backup") else []
        self._stand_in = StandIn(env, fallback, plant, backups)
        if constraint is not None:
            assert plant is not None
            plant.bind(env)
            self._room.bind(plant)
        if reach is None and measured is not None:
            raise ConfigurationError("measured is for reach, which is missing: give both, or neither")
        self._admission = None if reach is None else Admission(env, reach, measured, space.shape[0])
        self._shape, self._dtype = space.shape, space.dtype
        self._box = tuple(
            np.nan_to_num(np.asarray(end)).astype(np.float64) for end in (space.low, space.high)
        )
        self._filtered = is_filtered(env)  # then it says what was executed, else this one does
        self._warned = False
        self._forget()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env; no command is in force."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._stand_in.reset()
        self._room.reset()
        self._forget()
        info[keys.LEASE_REMAINING_S] = 0.0
        if not self._filtered:
            info[keys.EXECUTED_ACTION] = np.zeros(self._shape)
        info.update(dict.fromkeys((keys.LEASE_EXPIRED, keys.LEASE_REFUSED, keys.LEASE_BRAKING), False))
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute the action under its lease, the command in force under its own, or the fallback."""
        command = self._checked(action)
        now = self.now_s
        arrived, fresh, refused = self._judged(command, now)
        if fresh:
            granted = self._grant(now)
            refused |= not granted
        covered = now + self.hold_s <= self._until_s + _SAME_TIME * self.hold_s
        expired = not covered and self._until_s > -math.inf
        if covered:
            if arrived:
                self._command = np.array(action)  # its own copy: a policy may reuse its buffer
            if self._braking:
                self._braking, self._fade = False, self._fade_over(self._blend_steps)
            # The env gets a copy as well: it may scale in place what is still in force.
            sent = self._command.copy() if self._fade is None else self._faded(self._command)
        else:
            self._until_s = -math.inf
            if not self._braking:
                self._braking, self._fade = True, self._fade_over(self._brake_steps)
            sent = self._faded(self._stand_in.command())
        executed = sent.astype(np.float64)
        observation, reward, terminated, truncated, info = self.env.step(sent)
        if self._filtered:
            executed = np.array(info[keys.EXECUTED_ACTION], dtype=np.float64)
        else:
            info[keys.EXECUTED_ACTION] = executed.copy()
        self._executed = executed
        self._stand_in.executed(self._executed)
        self._steps_done += 1
        self._evidence = self.now_s
        info[keys.LEASE_REMAINING_S] = max(self._until_s - self.now_s, 0.0)
        info[keys.LEASE_EXPIRED] = expired
        info[keys.LEASE_REFUSED] = refused
        info[keys.LEASE_BRAKING] = not covered
        return observation, reward, terminated, truncated, info

    @property
    def now_s(self) -> float:
        """Seconds of the episode so far, on the clock of control steps."""
        return self._steps_done * self.hold_s

    def deliver(self, observed_s: float | None) -> None:
        """Say what the next action is made from; without a word it is made from the newest observation.

        Args:
            observed_s: When its observation was made, s on the clock of `now_s`. None: nothing arrives, the next
                step's action is disregarded.
        """
        if observed_s is not None and not math.isfinite(observed_s):
            raise ActionError(f"observed_s is a time in seconds, or None for nothing; got {observed_s!r}")
        self._evidence = observed_s

    def admits(self, end: Array, steps: int) -> bool:
        """Whether a chunk of position setpoints may be executed: is its end within idealised reach?

        Necessary only: what is admitted still needs its path and its stopping checked. True without `reach`.

        Args:
            end: The chunk's last command, shape (m,).
            steps: Control steps from now to the end of that command.
        """
        admitted = self._admission is None or self._admission.admits(end, steps * self.hold_s)
        self._chunk_refused |= not admitted
        return admitted

    def _checked(self, action: Any) -> Array:
        try:
            command = np.array(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise ActionError(f"expected an action of shape {self._shape}, got {action!r}") from None
        if command.shape != self._shape:
            raise ActionError(f"expected an action of shape {self._shape}, got shape {command.shape}")
        return command

    def _judged(self, command: Array, now: float) -> tuple[bool, bool, bool]:
        """Whether there is a command that may be executed, whether it is a fresh one, whether one was refused."""
        evidence, refused = self._evidence, self._chunk_refused
        self._chunk_refused = False
        if evidence is None:
            return False, False, refused
        slack = _SAME_TIME * self.hold_s
        newest = self._newest_s
        from_future = evidence > now + self._clock_error_s + slack
        finite = bool(np.isfinite(command).all())
        if not finite and not self._warned:
            self._warned = True
            warnings.warn(
                f"the policy's action is not finite ({command}); the command in force goes on under its lease",
                UserWarning,
                stacklevel=4,
            )
        if from_future or evidence < newest - slack or not finite:
            return False, False, True
        fresh = evidence > newest + slack
        if fresh:
            self._newest_s = evidence
        return True, fresh, refused

    def _grant(self, now: float) -> bool:
        """A new lease for the command in hand; False, and none at all, where it would not last."""
        delays_s = self._delays_s + max(now - self._newest_s, 0.0)
        longest_s = self._room.longest_lease(delays_s)
        lease = max(min(longest_s, self._longest_s), self._least_s)
        # What cannot be read gives no lease at all: a filter inside knows no better.
        granted = longest_s == longest_s and lease + _SAME_TIME * self.hold_s >= self.hold_s
        self._until_s = now + lease if granted else -math.inf
        return granted

    def _fade_over(self, steps: int) -> tuple[Array, int, int] | None:
        """From what was executed last, over so many steps; None where nothing was executed yet."""
        if self._executed is None or steps == 0:
            return None
        return np.clip(self._executed, *self._box), steps, 0

    def _faded(self, target: Any) -> Any:
        """Blended, and in the box, so that rounding to its dtype makes no infinity of anything."""
        control = np.clip(np.asarray(target, dtype=np.float64), *self._box)
        if self._fade is not None:
            latched, steps, done = self._fade
            weight = float(smoothstep((done + 1.0) / (steps + 1.0)))
            control = latched * (1.0 - weight) + weight * control
            self._fade = (latched, steps, done + 1) if done + 1 < steps else None
        return control.astype(self._dtype)

    def _steps(self, name: str, value: float) -> int:
        """Whole control steps, rounded up."""
        return math.ceil(non_negative(name, value, "s") / self.hold_s - _SAME_TIME)

    def _forget(self) -> None:
        self._steps_done = 0
        self._until_s = self._newest_s = -math.inf
        self._evidence = 0.0
        self._command = np.clip(np.zeros(self._shape), *self._box).astype(self._dtype)
        self._executed = None
        self._braking = self._chunk_refused = False
        self._fade = None


def _least(env: gym.Env[Any, Any], least_s: float, longest_s: float) -> float:
    least_s = non_negative("least_s", least_s, "s")
    if least_s > longest_s:
        raise ConfigurationError(f"least_s = {least_s} s is more than longest_s = {longest_s} s")
    if least_s > 0.0 and not is_filtered(env):
        raise ConfigurationError(
            f"least_s = {least_s} s without a CBFActionFilter inside would let a command drive into the obstacle: "
            "leave it 0, or put the filter inside, LeaseExpiry(sw.protect(env), ...)"
        )
    return least_s


def lease_inside(env: gym.Env[Any, Any]) -> LeaseExpiry | None:
    """The LeaseExpiry among an env's wrappers, if there is one."""
    return next((inner for inner in wrappers_of(env) if isinstance(inner, LeaseExpiry)), None)
