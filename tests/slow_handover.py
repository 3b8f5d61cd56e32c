"""What ChunkHandover's docstrings say, once more: slow, in plain Python, one number at a time."""

import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


def smooth(s):
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


class Tick(NamedTuple):
    """One control step."""

    control: list
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
    fade: tuple | None = None

    @property
    def step(self):
        return self.limit * self.hold

    def box(self, command):
        return [min(max(float(x), self.low), self.high) for x in command]

    def submit(self, chunk, observed, due):
        """True if it is on its way."""
        waiting = [c["observed"] for c in self.coming]
        if observed <= max([self.in_force, *waiting]) or observed > self.now:
            return False
        if not all(math.isfinite(x) for row in chunk for x in row):
            return False
        self.coming.append({"rows": [self.box(row) for row in chunk], "observed": observed, "due": due})
        return True

    def tick(self, fallback):
        seam, refused = self.arrive()
        starved = not self.plan
        control, exact = (self.box(fallback()), True) if starved else self.plan.pop(0)
        if self.sent and starved != self.starving and not seam:
            change = max(abs(a - b) for a, b in zip(control, self.sent[-1], strict=True))
            self.fade = (self.sent[-1], self.fade_steps(change), 1)
        self.starving = starved
        if self.fade is not None:
            start, steps, i = self.fade
            if i <= steps:
                alpha = smooth(i / (steps + 1))
                control = [(1 - alpha) * a + alpha * b for a, b in zip(start, control, strict=True)]
                exact, self.fade = False, (start, steps, i + 1)
        control, limited = self.held_back(control, exact)
        control = [float(self.dtype(x)) for x in control]
        self.sent.append(control)
        self.now += 1
        return Tick(control, exact and not limited, starved, limited, refused)

    def held_back(self, control, exact):
        """A command within the limit of the last one, and whether it was not."""
        if not self.sent:
            return control, False
        pairs = list(zip(self.sent[-1], control, strict=True))
        excess = [abs(b - a) - self.step for a, b in pairs]
        self.close_calls += sum(-1e-5 < x < 1e-5 and not (exact and x <= 0) for x in excess)
        return [min(max(b, a - self.step), a + self.step) for a, b in pairs], max(excess) > 0

    def fade_steps(self, change):
        """As many as a blend between two latched commands needs: 1.875 |change| / limit is its time."""
        if math.isinf(self.limit):
            return self.fewest
        needed = 1.875 * change / self.limit / self.hold
        self.close_calls += 1e-7 < abs(needed - round(needed)) < 1e-5
        return max(self.fewest, math.ceil(needed - 1e-6) - 1)

    def arrive(self):
        """Whether a chunk took over from another command, and whether one was refused."""
        there = [c for c in self.coming if c["due"] <= self.now]
        if not there:
            return False, False
        self.coming = [c for c in self.coming if c["due"] > self.now]
        alive = [c for c in there if self.now - c["observed"] < len(c["rows"])]
        best = max([c["observed"] for c in alive], default=-1)
        refused = any(c["observed"] > best for c in there if c not in alive)
        if not alive:
            return False, refused
        newest = max(alive, key=lambda c: c["observed"])
        self.coming = [c for c in self.coming if c["observed"] > best]
        self.in_force = best
        fresh = newest["rows"][self.now - best :]
        if len(newest["rows"]) == 1:
            self.plan = [(row, True) for row in fresh]
            return False, refused
        steps, plan = self.shortest([row for row, _ in self.plan], fresh) if self.sent else (0, fresh)
        self.plan = [(row, i >= steps) for i, row in enumerate(plan)]
        self.fade = None
        return bool(self.sent), refused

    def shortest(self, prior, new):
        """The steps of the shortest blend that keeps the limit, or of the one that exceeds it least; its commands."""
        last = self.sent[-1]
        fewest = min(self.fewest, len(new) - 1)
        jump = max(abs(a - b) for a, b in zip(new[0], last, strict=True))
        if fewest == 0 and jump <= self.step:
            return 0, list(new)
        self.close_calls += 0 < jump - self.step < 1e-5
        best = None
        for n in range(max(fewest, 1) if len(new) > 1 else 0, len(new)):
            plan = self.blended(n, prior, new)
            chain = [last, *plan[: n + 1]]
            peak = max(abs(b[k] - a[k]) for a, b in itertools.pairwise(chain) for k in range(len(last)))
            self.close_calls += math.isfinite(self.step) and abs(peak - self.step) < 1e-5
            self.close_calls += best is not None and best[0] > self.step and abs(best[0] - peak) < 1e-6
            if best is None or (best[0] > self.step and peak < best[0]):
                best = peak, n, plan
            if peak <= self.step:
                break
        return best[1], best[2]

    def blended(self, n, prior, new):
        """A blend of n steps: from the prior stream if that lasts for all of it, or else from the last command."""
        plan = [list(row) for row in new]
        for i in range(n):
            before = prior[i] if n <= len(prior) else self.sent[-1]
            alpha = smooth((i + 1) / (n + 1))
            plan[i] = [(1 - alpha) * a + alpha * b for a, b in zip(before, new[i], strict=True)]
        return plan
