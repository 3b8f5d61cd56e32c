"""ChunkQueue: which command a robot executes while chunks arrive late, broken or not at all."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array, positive, whole_number
from safe_wrappers.control.handover import (
    LOOK_BACK,
    Seam,
    SeamCheck,
    SeamLimits,
    hermite_spline,
    join,
    shortest_blend,
    smoothstep,
)
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.layer import whole_steps


class Command(NamedTuple):
    """What to send in a control step."""

    control: NDArray[Any]  # shape (m,), in the env's dtype and inside its box
    observed: int  # control step whose observation the command was made from; -1 before there was any
    starved: bool  # the queue is empty: the fallback gave it
    limited: bool  # held back beyond the blend to keep the rate limit
    refused: bool  # a chunk that has arrived was refused


class Chunk(NamedTuple):
    """A chunk on its way, or there."""

    commands: Array  # shape (h, m), the first one for the control step of the observation
    observed: int  # control step of the observation
    due: int  # control step at which it is there


class ChunkQueue:
    """Which command comes next, counted in control steps.

    A chunk that was observed at step k and is there at step t is consumed from its entry t - k on. A chunk of one has
    no left-over to blend with: only a change to and from the fallback is faded over.

    Args:
        space: Of single commands, shape (m,); what is outside is clipped, at most to the largest number of the dtype.
        control_dt: Control interval, s.
        blend: A blend of `control/handover.py`.
        fewest: A blend takes at least so many control steps.
        rate_limit: Largest |du/dt| of every component, shape (m,), action units per second; infinite for none.
        check: Of the machine's limits; None accepts all blends.
    """

    def __init__(
        self,
        space: gym.spaces.Box,
        control_dt: float,
        blend: str,
        fewest: int,
        rate_limit: Array,
        check: SeamCheck | None = None,
    ) -> None:
        self._control_dt, self._blend, self._fewest = control_dt, blend, fewest
        self._rate_limit, self._check = rate_limit, check
        step = np.asarray(rate_limit * control_dt)
        # The difference of two commands, divided by the interval again, must not come out above the limit.
        self._step = np.where(step / control_dt > rate_limit, np.nextafter(step, 0.0), step)
        dtype: Any = space.dtype
        self._dtype = np.dtype(dtype)
        largest = min(float(np.finfo(dtype).max), float(np.finfo(np.float32).max))
        self._low = np.maximum(np.asarray(space.low, np.float64), -largest)
        self._high = np.minimum(np.asarray(space.high, np.float64), largest)
        self._none = np.zeros((0, self._low.size))
        self.reset()

    def reset(self) -> None:
        """A new episode: nothing sent, nothing planned."""
        self.now = 0
        self._observed = -1
        self._sent = self._none
        self._plan, self._limited = self._none, np.zeros(0, dtype=bool)
        self._coming: list[Chunk] = []
        self._starved: bool | None = None
        self._fade: tuple[Array, int, int] | None = None  # the latched command, steps, done

    def submit(self, commands: Array, observed: int, due: int) -> bool:
        """A chunk, shape (h, m), observed at a control step, is on its way; False if it is refused.

        Refused are a chunk with an entry that is not finite, and one whose observation is in the future or not newer
        than all before it.
        """
        newest = max([self._observed, *(c.observed for c in self._coming)])
        if not newest < observed <= self.now or not np.isfinite(commands).all():
            return False
        boxed = np.clip(commands, self._low, self._high)
        self._coming.append(Chunk(boxed, observed, due))
        return True

    def next(self, admits: Callable[[Array], bool], fallback: Callable[[], Array]) -> Command:
        """The command of this control step.

        Args:
            admits: Whether a chunk that has arrived may take over, by its commands from this control step on, shape
                (h, m).
            fallback: Called when nothing is planned; returns a finite control of shape (m,).
        """
        chunk, refused = self._admitted(admits)
        self._coming = [c for c in self._coming if c.due > self.now]
        seam = False
        if chunk is not None:
            joined = self._take_over(chunk)
            refused |= joined is None
            seam = bool(joined)
        control, limited = self._planned()
        starved = control is None
        if control is None:
            control = np.clip(fallback(), self._low, self._high)
        if starved != self._starved and len(self._sent) and not seam:
            # A longer chunk that takes over blends by itself; everything else starts from the last command.
            self._fade = (self._sent[-1], self._fade_steps(control), 0)
        self._starved = starved
        sent, held = self._sendable(self._faded(control))
        self._sent = np.concatenate([self._sent[-LOOK_BACK + 1 :], sent[None].astype(np.float64)])
        self.now += 1
        return Command(sent, self._observed, starved, held or limited, refused)

    def _admitted(self, admits: Callable[[Array], bool]) -> tuple[Chunk | None, bool]:
        """The chunk of the newest observation that may take over now, if any; and whether one was refused."""
        refused = False
        for chunk in reversed([c for c in self._coming if c.due <= self.now]):
            left = chunk.commands[self.now - chunk.observed :]
            if len(left) and admits(left):
                return chunk, refused
            refused = True  # it came too late, or must not
        return None, refused

    def _take_over(self, chunk: Chunk) -> bool | None:
        """Let a chunk take over: whether it is a seam; None if no blend keeps the limits."""
        fresh = chunk.commands[self.now - chunk.observed :]
        joined = (
            self._joined(fresh)
            if len(chunk.commands) > 1
            else Seam(fresh, 0, np.zeros(len(fresh), dtype=bool))
        )
        if joined is None:
            return None
        self._coming = [c for c in self._coming if c.observed > chunk.observed]
        self._observed = chunk.observed
        self._plan, self._limited = joined.plan, joined.limited
        if len(chunk.commands) == 1:
            return False
        self._fade = None
        return len(self._sent) > 0

    def _joined(self, fresh: Array) -> Seam | None:
        """The blend into a chunk's rest, shape (n, m); None if none keeps the machine's limits."""
        return join(
            self._sent,
            self._plan,
            fresh,
            self._control_dt,
            blend=self._blend,
            fewest=self._fewest,
            rate_limit=self._rate_limit,
            low=self._low,
            high=self._high,
            accepts=None if self._check is None else partial(self._check.accepts, self._sent, fresh),
        )

    def _planned(self) -> tuple[Array | None, bool]:
        if not len(self._plan):
            return None, False
        control, limited = self._plan[0], bool(self._limited[0])
        self._plan, self._limited = self._plan[1:], self._limited[1:]
        return control, limited

    def _fade_steps(self, target: Array) -> int:
        """Control steps between the latched command and the new one that keep the limits, were both at rest."""
        change = np.abs(target - self._sent[-1])
        shortest = 0.0 if self._check is None else self._check.shortest_fade(change)
        bounded = np.isfinite(self._rate_limit)
        if bounded.any():
            shortest_by_rate = shortest_blend(change[bounded], self._rate_limit[bounded])
            shortest = max(shortest, float(shortest_by_rate.max()))
        return max(self._fewest, whole_steps(shortest, self._control_dt) - 1)

    def _faded(self, control: Array) -> Array:
        if self._fade is None:
            return control
        latched, steps, done = self._fade
        if done >= steps:
            self._fade = None
            return control
        self._fade = (latched, steps, done + 1)
        weight = float(smoothstep((done + 1.0) / (steps + 1.0)))
        return np.asarray(latched + weight * (control - latched))

    def _sendable(self, control: Array) -> tuple[NDArray[Any], bool]:
        """The command in the env's dtype, within the box and the limit, and whether it had to be held back."""
        control = np.clip(control, self._low, self._high)
        if not len(self._sent):
            return control.astype(self._dtype), False
        last = self._sent[-1]
        kept = np.clip(control, last - self._step, last + self._step)
        sent = kept.astype(self._dtype)
        # Rounding alone may break the limit by a hair: one number back, which is not called holding back.
        too_far = np.abs(sent - last) > self._step
        sent = np.where(too_far, np.nextafter(sent, last.astype(self._dtype)), sent)
        hair = 2.0 * float(np.finfo(self._dtype).eps) * np.maximum(np.abs(control), np.abs(last))
        return sent, bool((np.abs(control - kept) > hair).any())


class ChunkSizes(NamedTuple):
    """In control steps, by the names of real-time chunking: H, s, and the least and the most of d."""

    entries: int  # chunk_size
    steps_per_entry: int  # control steps from one entry to the next
    chunk: int  # H, the control steps that a chunk has a command for; with one step per entry its entries
    horizon: int  # execution_horizon s
    delay: tuple[int, int]  # the least and the largest inference_delay d; d <= s <= H - d holds for both

    @classmethod
    def checked(
        cls, chunk_size: Any, execution_horizon: Any, inference_delay: Any, steps_per_entry: Any
    ) -> "ChunkSizes":
        """The sizes as the user gave them, or an error that says what would fit."""
        entries = whole_number("chunk_size", chunk_size, 1, "control steps")
        horizon = whole_number("execution_horizon", execution_horizon, 1, "control steps")
        apart = whole_number("steps_per_entry", steps_per_entry, 1, "control steps")
        if entries == 1 and apart > 1:
            raise ConfigurationError(f"steps_per_entry = {apart}: one entry leads to no other")
        size = (entries - 1) * apart + 1
        delay = _delay(inference_delay)
        if not delay[1] <= horizon <= size - delay[1]:
            given = f"inference_delay d = {delay[1]}, execution_horizon s = {horizon}, chunk_size {entries}"
            fits = (
                f"choose s from {max(delay[1], 1)} to {size - delay[1]}"
                if 2 * delay[1] < size
                else "no s fits"
            )
            raise ConfigurationError(f"{given}, H = {size} control steps: d <= s <= H - d must hold; {fits}")
        return cls(entries, apart, size, horizon, delay)


def blend_bounds(
    sizes: ChunkSizes,
    space: gym.spaces.Box,
    control_dt: float,
    blend: str,
    blend_time: float | None,
    rate_limit: float | Sequence[float] | None,
    limits: SeamLimits | None = None,
) -> tuple[int, Array]:
    """The fewest steps of a blend, and the rate limit of every component, shape (m,), infinite for none."""
    if limits is not None and blend != "quintic":
        raise ConfigurationError(f'limits are kept by blend="quintic", whose ends match; got {blend!r}')
    fewest, rates = 0, np.full(space.shape, np.inf)
    if rate_limit is not None:
        rates = _rate_limits(rate_limit, rates.size)
    resolution = _rounding(space)
    if (rates * control_dt <= resolution).any():
        least = f"what {space.dtype} resolves in {control_dt} s, {resolution / control_dt:.3g} per second"
        raise ConfigurationError(f"rate_limit = {rate_limit} is not above {least}: choose a larger one")
    available = sizes.chunk - sizes.delay[1]
    if blend_time is not None:
        fewest = max(whole_steps(positive("blend_time", blend_time, "s"), control_dt) - 1, 1)
        if fewest >= available and sizes.chunk > 1:
            left = f"{available} control steps of {control_dt} s"
            longer = f"blend_time = {blend_time} s is longer than a chunk's rest, {left}"
            raise ConfigurationError(f"{longer}: choose a longer chunk_size or a shorter blend_time")
    if blend_time is None and rate_limit is None and limits is None:
        fewest = available - sizes.horizon  # the least left-over
        if fewest == 0:
            has = f"chunk_size {sizes.chunk}, execution_horizon {sizes.horizon}, inference_delay {sizes.delay[1]}"
            raise ConfigurationError(f"{has}: no left-over to blend with: pass rate_limit or blend_time")
    return fewest, rates


def _delay(value: Any) -> tuple[int, int]:
    if not isinstance(value, list | tuple):
        return (whole_number("inference_delay", value, 0, "control steps"),) * 2
    counts = [whole_number("inference_delay", delay, 0, "control steps") for delay in value]
    if len(counts) != 2 or counts[0] > counts[1]:
        raise ConfigurationError(f"inference_delay is d control steps or [least, most], got {value!r}")
    return counts[0], counts[1]


def _rate_limits(rate_limit: Any, controls: int) -> Array:
    unit = "action units per second"
    if not isinstance(rate_limit, list | tuple | np.ndarray):
        return np.full(controls, positive("rate_limit", rate_limit, unit))
    if len(rate_limit) != controls:
        wanted = f"one number, or one for each of the {controls} action components"
        raise ConfigurationError(f"rate_limit is {wanted}; got {rate_limit!r}")
    return np.array([positive("rate_limit", each, unit) for each in rate_limit])


def _rounding(space: gym.spaces.Box) -> float:
    """The most that rounding to the actions' dtype may add to the difference of two commands in the box."""
    ends = np.abs(np.concatenate([space.low, space.high]).astype(np.float64))
    largest = float(ends[np.isfinite(ends)].max(initial=1.0))
    dtype: Any = space.dtype
    return 2.0 * float(np.finfo(dtype).eps) * largest


class Upsampling:
    """Chunks of entries that lie some control steps apart, as commands on a cubic Hermite spline through the entries.

    A chunk ends with its last entry. Between entries the spline may overshoot their range.
    """

    def __init__(self, entries: int, steps: int) -> None:
        self._steps = steps
        if steps > 1:
            # The spline is linear in the entries: one matrix for all chunks.
            spline = hermite_spline(np.eye(entries), float(steps))
            self._weights = np.asarray(spline(np.arange((entries - 1) * steps + 1.0)))

    def bears_knots(self, chunk: Array, check: SeamCheck, control_dt: float) -> bool:
        """Whether the torque steps where the spline's pieces meet keep the machine's limits."""
        return self._steps == 1 or check.bears_knots(chunk, self._steps * control_dt)

    def commands(self, chunk: Array) -> Array:
        """The commands of a chunk (H, m), shape ((H - 1) steps + 1, m); at the entries these bit for bit."""
        if self._steps == 1:
            return chunk
        commands = self._weights @ chunk
        commands[:: self._steps] = chunk
        return commands
