"""What ChunkHandover's docstrings say, once more: slow, and one command at a time."""

import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


def smooth(s):
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


def mixed(before, after, s):
    return (1 - smooth(s)) * before + smooth(s) * after


class Tick(NamedTuple):
    """One control step."""

    control: np.ndarray
    exact: bool  # the bits are a chunk's own
    starved: bool
    limited: bool
    refused: bool


@dataclass
class Slow:
    hold: float
    fewest: int = 0
    limit: float = math.inf
    low: float = -math.inf
    high: float = math.inf
    dtype: type = np.float32
    close_calls: int = 0
    """Decisions that rounding might turn: the comparison ends there."""
    coming: list = field(default_factory=list)
    sent: list = field(default_factory=list)
    plan: list = field(default_factory=list)
    now: int = 0
    in_force: int = -1
    starving: bool | None = None
    fade: tuple = (None, 0, 1)

    @property
    def step(self):
        return self.limit * self.hold

    def submit(self, chunk, observed, due):
        """True if it is on its way."""
        newest = max([self.in_force, *(c["observed"] for c in self.coming)])
        if not newest < observed <= self.now or not np.isfinite(chunk).all():
            return False
        rows = list(np.clip(chunk.astype(float), self.low, self.high))
        self.coming.append({"rows": rows, "observed": observed, "due": due})
        return True

    def tick(self, fallback):
        seam, refused = self.arrive()
        starved, limited = not self.plan, False
        control, exact = (np.clip(fallback(), self.low, self.high), True) if starved else self.plan.pop(0)
        if self.sent and starved != self.starving and not seam:
            change = abs(control - self.sent[-1]).max()
            self.fade = self.sent[-1], self.fade_steps(change), 1
        self.starving = starved
        start, steps, i = self.fade
        if i <= steps:
            control, exact = mixed(start, control, i / (steps + 1)), False
            self.fade = start, steps, i + 1
        if self.sent:
            last = self.sent[-1]
            excess = abs(control - last) - self.step
            self.close_calls += ((abs(excess) < 1e-5) & ~(exact & (excess <= 0))).sum()
            control, limited = np.clip(control, last - self.step, last + self.step), excess.max() > 0
        self.sent.append(control.astype(self.dtype).astype(float))
        self.now += 1
        return Tick(self.sent[-1], exact and not limited, starved, limited, refused)

    def fade_steps(self, change):
        """As many as a blend between two latched commands needs: 1.875 |change| / limit is its time."""
        needed = 1.875 * change / self.limit / self.hold
        self.close_calls += 1e-7 < abs(needed - round(needed)) < 1e-5
        return max(self.fewest, math.ceil(needed - 1e-6) - 1)

    def arrive(self):
        """Whether a chunk took over from another command, and whether one was refused."""
        there = [c for c in self.coming if c["due"] <= self.now]
        over = [self.now - c["observed"] >= len(c["rows"]) for c in there]
        best = max([c["observed"] for c, is_over in zip(there, over, strict=True) if not is_over], default=-1)
        refused = any(is_over and c["observed"] > best for c, is_over in zip(there, over, strict=True))
        self.coming = [c for c in self.coming if c["due"] > self.now and c["observed"] > best]
        if best < 0:
            return False, refused
        newest = next(c for c in there if c["observed"] == best)
        self.in_force = best
        fresh = newest["rows"][self.now - best :]
        if len(newest["rows"]) == 1:
            self.plan = [(row, True) for row in fresh]
            return False, refused
        steps, plan = self.shortest([row for row, _ in self.plan], fresh) if self.sent else (0, fresh)
        self.plan = [(row, i >= steps) for i, row in enumerate(plan)]
        self.fade = None, 0, 1
        return bool(self.sent), refused

    def shortest(self, prior, new):
        """The steps of the shortest blend that keeps the limit, or of the one that exceeds it least; its commands."""
        last = self.sent[-1]
        fewest = min(self.fewest, len(new) - 1)
        jump = abs(new[0] - last).max()
        if fewest == 0 and jump <= self.step:
            return 0, new
        self.close_calls += 0 < jump - self.step < 1e-5
        least, found = math.inf, None
        for n in range(max(fewest, 1) if len(new) > 1 else 0, len(new)):
            plan = self.blended(n, prior, new)
            peak = max(abs(b - a).max() for a, b in itertools.pairwise([last, *plan[: n + 1]]))
            self.close_calls += math.isfinite(self.step) and abs(peak - self.step) < 1e-5
            self.close_calls += least > self.step and abs(least - peak) < 1e-6
            if peak < least:
                least, found = peak, (n, plan)
            if peak <= self.step:
                break
        return found

    def blended(self, n, prior, new):
        """A blend of n steps: from the prior stream if that lasts for all of it, or else from the last command."""
        before = prior[:n] if n <= len(prior) else [self.sent[-1]] * n
        mix = [mixed(a, b, (i + 1) / (n + 1)) for i, (a, b) in enumerate(zip(before, new, strict=False))]
        return [*mix, *new[n:]]
