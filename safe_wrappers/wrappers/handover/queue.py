"""ChunkQueue: which command a robot executes while chunks arrive late, broken or not at all."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.handover.seams import BLENDS, DIFFERENCES, join
from safe_wrappers.control.handover.smoothstep import shortest_latched_blend, smoothstep
from safe_wrappers.wrappers.common.layer import Array
from safe_wrappers.wrappers.common.receiver import whole_steps

REPLACE: Final = "replace"
ENSEMBLE: Final = "ensemble"
BASELINES: Final = (REPLACE, ENSEMBLE)
"""What is done without a bound on the seam: the new chunk at once, or the mean of all chunks at hand."""


class Command(NamedTuple):
    """What to send in a control step."""

    control: NDArray[Any]  # shape (m,), in the env's dtype and inside its box
    observed: int  # control step whose observation the command was made from; -1 before there was any
    starved: bool  # the queue is empty: the fallback gave it
    limited: bool  # held back beyond the blend to keep the rate limit
    took_over: bool  # a chunk took over with it
    refused: bool  # a chunk that has arrived was refused
    seam: bool  # there is a seam before it: another chunk, another source, or the fallback began
    blend_steps: int  # control steps of the blend that begins with this command; 0 if none does


class Chunk(NamedTuple):
    """A chunk on its way, or there."""

    commands: Array  # shape (h, m), the first one for the control step of the observation
    observed: int  # control step of the observation
    due: int  # control step at which it is there


class ChunkQueue:
    """Which command comes next, counted in control steps.

    A chunk that was observed at step k and is there at step t is consumed from its entry t - k on. A chunk of one has
    no left-over to blend with: only a change of its source (`switch`), to and from the fallback too, is faded over.

    Args:
        space: Of single commands, shape (m,); what is outside is clipped, at most to the largest number of the dtype.
        control_dt: Control interval, s.
        blend: A blend of `control/handover/seams.py`, "replace" or "ensemble".
        fewest: A blend takes at least so many control steps.
        rate_limit: Largest |du/dt| of every component, shape (m,), action units per second; infinite for none.
        decay: Ensembling weighs the i-th oldest chunk by exp(-decay i).
    """

    def __init__(
        self,
        space: gym.spaces.Box,
        control_dt: float,
        blend: str,
        fewest: int,
        rate_limit: Array,
        decay: float,
    ) -> None:
        self._control_dt, self._blend, self._fewest, self._decay = control_dt, blend, fewest, decay
        self._rate_limit = rate_limit
        step = np.asarray(rate_limit * control_dt)
        # The difference of two commands, divided by the interval again, must not come out above the limit.
        self._step = np.where(step / control_dt > rate_limit, np.nextafter(step, 0.0), step)
        dtype: Any = space.dtype
        self._dtype = np.dtype(dtype)
        largest = min(float(np.finfo(dtype).max), float(np.finfo(np.float32).max))
        self._low = np.maximum(np.asarray(space.low, np.float64), -largest)
        self._high = np.minimum(np.asarray(space.high, np.float64), largest)
        self._none = np.zeros((0, self._low.size))
        self._source = ""
        self.reset()

    def reset(self) -> None:
        """A new episode: nothing sent, nothing planned; the source stays the one that was named last."""
        self.now = 0
        self._observed = -1
        self._sent = self._none
        self._plan, self._limited = self._none, np.zeros(0, dtype=bool)
        self._coming: list[Chunk] = []
        self._averaged: list[Chunk] = []
        self._in_force = self._source
        self._acting: str | None = None
        self._fade: tuple[Array, int, int] | None = (
            None  # a change of source: the latched command, steps, done
        )

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

    def switch(self, source: str) -> None:
        """Chunks that take over from now on are somebody else's; the change is blended, from the last command."""
        self._source = source

    def next(self, admits: Callable[[Array], bool], fallback: Callable[[], Array]) -> Command:
        """The command of this control step.

        Args:
            admits: Whether a chunk that has arrived may take over, by its commands from this control step on, shape
                (h, m).
            fallback: Called when nothing is planned; returns a finite control of shape (m,).
        """
        admitted, refused = self._admitted(admits)
        newest = self._observed
        self._coming = [c for c in self._coming if c.due > self.now]
        seam, blend_steps = self._take_over(admitted) if admitted else (False, 0)
        control, limited = self._planned()
        starved = control is None
        if control is None:
            control = np.clip(fallback(), self._low, self._high)
        acting = None if starved else self._in_force
        if acting != self._acting and len(self._sent):
            # A longer chunk that takes over blends by itself; everything else starts from the last command.
            if not seam and self._blend in BLENDS:
                blend_steps = self._fade_steps(control)
                self._fade = (self._sent[-1], blend_steps, 0)
            seam = True
        self._acting = acting
        sent, held = self._sendable(self._faded(control))
        self._sent = np.concatenate([self._sent[-DIFFERENCES + 1 :], sent[None].astype(np.float64)])
        self.now += 1
        took_over = self._observed > newest
        return Command(sent, self._observed, starved, limited or held, took_over, refused, seam, blend_steps)

    def _admitted(self, admits: Callable[[Array], bool]) -> tuple[list[Chunk], bool]:
        """The chunks that may take over now, the newest observation first; and whether one was refused."""
        admitted: list[Chunk] = []
        refused = False
        for chunk in reversed([c for c in self._coming if c.due <= self.now]):
            left = chunk.commands[self.now - chunk.observed :]
            if not (len(left) and admits(left)):  # it came too late, or must not
                refused = True
                continue
            admitted.append(chunk)
            if self._blend != ENSEMBLE:
                break
        return admitted, refused

    def _take_over(self, admitted: list[Chunk]) -> tuple[bool, int]:
        """Let the newest of these take over, or all in an ensemble: whether it is a seam, and its blend's steps."""
        newest = admitted[0]
        self._coming = [c for c in self._coming if c.observed > newest.observed]
        self._observed, self._in_force = newest.observed, self._source
        if self._blend == ENSEMBLE:
            self._averaged += reversed(admitted)
            return len(self._sent) > 0, 0
        fresh = newest.commands[self.now - newest.observed :]
        if self._blend == REPLACE or len(newest.commands) == 1:
            self._plan, self._limited = fresh, np.zeros(len(fresh), dtype=bool)
            return self._blend == REPLACE and len(self._sent) > 0, 0
        blend: Any = self._blend  # checked by the wrapper
        bounds: dict[str, Any] = {"rate_limit": self._rate_limit, "low": self._low, "high": self._high}
        motion = self._sent, self._plan, fresh
        joined = join(*motion, self._control_dt, blend=blend, fewest=self._fewest, **bounds)
        self._plan, self._limited = joined.plan, joined.limited
        self._fade = None
        return len(self._sent) > 0, joined.steps

    def _planned(self) -> tuple[Array | None, bool]:
        if self._blend == ENSEMBLE:
            self._averaged = [c for c in self._averaged if c.observed + len(c.commands) > self.now]
            if not self._averaged:
                return None, False
            votes = np.array([c.commands[self.now - c.observed] for c in self._averaged])
            weights = np.exp(-self._decay * np.arange(len(votes)))
            return np.asarray(weights @ votes / weights.sum()), False
        if not len(self._plan):
            return None, False
        control, limited = self._plan[0], bool(self._limited[0])
        self._plan, self._limited = self._plan[1:], self._limited[1:]
        return control, limited

    def _fade_steps(self, target: Array) -> int:
        """Control steps between the latched command and the new one that keep the limit, were both at rest."""
        steps = self._fewest
        bounded = np.isfinite(self._rate_limit)
        if bounded.any():
            change = np.abs(target - self._sent[-1])[bounded]
            shortest = float(shortest_latched_blend(change, self._rate_limit[bounded]).max())
            steps = max(steps, whole_steps(shortest, self._control_dt) - 1)
        return steps

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
        if self._blend not in BLENDS or not len(self._sent):
            return control.astype(self._dtype), False
        last = self._sent[-1]
        kept = np.clip(control, last - self._step, last + self._step)
        sent = kept.astype(self._dtype)
        # Rounding alone may break the limit by a hair: one number back, which is not called holding back.
        too_far = np.abs(sent - last) > self._step
        sent = np.where(too_far, np.nextafter(sent, last.astype(self._dtype)), sent)
        hair = 2.0 * float(np.finfo(self._dtype).eps) * np.maximum(np.abs(control), np.abs(last))
        return sent, bool((np.abs(control - kept) > hair).any())
