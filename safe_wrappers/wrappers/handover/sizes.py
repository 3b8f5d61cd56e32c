"""The sizes of chunks and the bounds on their blends, checked against each other; and chunks at a slower rate."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from safe_wrappers.checks import Array, positive, whole_number
from safe_wrappers.control.handover.seam_limits import SeamCheck, SeamLimits
from safe_wrappers.control.handover.seams import BLENDS
from safe_wrappers.control.handover.smoothstep import SMOOTHSTEP_PEAK_RATE
from safe_wrappers.control.handover.splines import hermite_series
from safe_wrappers.control.handover.vibration import shortest_smoothstep
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.queries.rigid_model import RigidModelCheck
from safe_wrappers.wrappers.common.receiver import whole_steps
from safe_wrappers.wrappers.handover.queue import BASELINES


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
        if horizon > size:
            has = _size(entries, apart, "")
            raise ConfigurationError(
                f"execution_horizon = {horizon} is more than {has}: choose it up to {size}"
            )
        if not delay[1] <= horizon <= size - delay[1]:
            late, between = (
                delay[1],
                f"choose s from {max(delay[1], 1)} to {size - delay[1]}, or longer chunks",
            )
            fits = between if 2 * late <= size else f"no s fits, choose H >= {2 * late}"
            raise ConfigurationError(
                f"inference_delay d = {late}, execution_horizon s = {horizon} and {_size(entries, apart, ' H')} "
                f"break d <= s <= H - d: a late chunk has {max(size - late, 0)} commands left; {fits}"
            )
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
    fewest, rate_limits = 0, np.full(space.shape, np.inf)
    given = {"blend_time": blend_time, "rate_limit": rate_limit, "limits": limits}
    named = [name for name, one in given.items() if one is not None]
    if blend in BASELINES:
        if named:
            bounded = ", ".join(BLENDS)
            baseline = f"blend={blend!r} is a baseline that bounds nothing"
            raise ConfigurationError(
                f"{baseline}: blend_time, rate_limit, limits and flexible are for {bounded}"
            )
        return fewest, rate_limits
    if blend_time is not None:
        fewest = max(whole_steps(positive("blend_time", blend_time, "s"), control_dt) - 1, 1)
        available = sizes.chunk - sizes.delay[1]
        if fewest >= available and sizes.chunk > 1:
            left = f"{available} control steps of {control_dt} s"
            longer = f"blend_time = {blend_time} s is longer than a chunk's rest, {left}"
            raise ConfigurationError(f"{longer}: choose a longer chunk_size or a shorter blend_time")
    if rate_limit is not None:
        rate_limits = _rate_limits(rate_limit, rate_limits.size)
        resolution = _rounding(space)
        if (rate_limits * control_dt <= resolution).any():
            least = f"what {space.dtype} resolves in {control_dt} s, {resolution / control_dt:.3g} per second"
            raise ConfigurationError(f"rate_limit = {rate_limit} is not above {least}: choose a larger one")
    if not named:
        fewest = sizes.chunk - sizes.horizon - sizes.delay[1]  # the least left-over
        if fewest == 0:
            has = f"chunk_size {sizes.chunk}, execution_horizon {sizes.horizon}, inference_delay {sizes.delay[1]}"
            raise ConfigurationError(f"{has}: no left-over to blend with: pass rate_limit or blend_time")
    return fewest, rate_limits


def bounds_for_springs(
    check: RigidModelCheck,
    share: float,
    space: gym.spaces.Box,
    blend_time: float | None,
    rate_limit: float | Sequence[float] | None,
) -> tuple[float, Sequence[float] | float | None]:
    """Blend time, s, and rate limit, each the stricter of the user's and of what springs ask.

    These ask for the time from which on a smoothstep leaves at most a share of a step's energy in them, and for the
    steepest rate of such a blend over the whole action range, if every component has one.
    """
    shortest = shortest_smoothstep(share, check.resonances[0])
    own = np.full(space.shape, np.inf) if rate_limit is None else _rate_limits(rate_limit, space.shape[0])
    rates = np.minimum(SMOOTHSTEP_PEAK_RATE * (space.high - space.low).astype(np.float64) / shortest, own)
    return max(shortest, blend_time or 0.0), rates.tolist() if np.isfinite(rates).all() else rate_limit


def _size(entries: int, apart: int, letter: str) -> str:
    if apart == 1:
        return f"chunk_size{letter} = {entries}"
    return f"chunk_size {entries} at {apart} control steps per entry, H = {(entries - 1) * apart + 1} control steps"


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
            times = np.arange(entries) * float(steps)
            unit = np.eye(entries)
            rates = np.asarray(np.gradient(unit, axis=1)) / steps
            # The spline is linear in the entries: one matrix for all chunks.
            self._weights = hermite_series(times, unit, rates, np.arange((entries - 1) * steps + 1)).T

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
