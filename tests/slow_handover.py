"""What ChunkHandover's docstrings say, once more: slow, in plain Python, one number at a time."""

import itertools
import math
from dataclasses import dataclass, field

import numpy as np


def smooth(s):
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


@dataclass
class Tick:
    """One control step."""

    control: list
    exact: bool = False
    """The bits are a chunk's own."""
    starved: bool = False
    limited: bool = False
    seam: bool = False
    blend_steps: int = 0
    refused: bool = False
    latency: int = -1


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
    acting: str = ""
    fade: tuple | None = None

    @property
    def step(self):
        return self.limit * self.hold

    def box(self, command):
        return [min(max(float(x), self.low), self.high) for x in command]

    def submit(self, chunk, observed, due):
        """True if it is on its way."""
        chunk = [[float(x) for x in row] for row in chunk]
        waiting = [c["observed"] for c in self.coming]
        if observed <= max([self.in_force, *waiting]) or observed > self.now:
            return False
        if not all(math.isfinite(x) for row in chunk for x in row):
            return False
        rows = [self.box(row) for row in chunk]
        self.coming.append({"rows": rows, "observed": observed, "due": due})
        return True

    def tick(self, fallback):
        tick = Tick(control=[])
        self.arrive(tick)
        tick.starved = not self.plan
        control, exact = (self.box(fallback), True) if tick.starved else self.plan.pop(0)
        acting = "the fallback" if tick.starved else "the chunks"
        if self.sent and acting != self.acting:
            if not tick.seam:
                change = max(abs(a - b) for a, b in zip(control, self.sent[-1], strict=True))
                tick.blend_steps = self.fade_steps(change)
                self.fade = (list(self.sent[-1]), tick.blend_steps, 1)
            tick.seam = True
        self.acting = acting
        if self.fade is not None:
            start, steps, i = self.fade
            if i <= steps:
                alpha = smooth(i / (steps + 1))
                control = [(1 - alpha) * a + alpha * b for a, b in zip(start, control, strict=True)]
                exact = False
                self.fade = (start, steps, i + 1)
            else:
                self.fade = None
        if self.sent:
            held = [
                min(max(b, a - self.step), a + self.step) for a, b in zip(self.sent[-1], control, strict=True)
            ]
            for a, b in zip(self.sent[-1], control, strict=True):
                excess = abs(b - a) - self.step
                self.close_calls += -1e-5 < excess < 1e-5 and not (exact and excess <= 0)
                if excess > 0:
                    tick.limited, exact = True, False
            control = held
        tick.control = [float(self.dtype(x)) for x in control]
        tick.exact = exact
        self.sent.append(tick.control)
        self.now += 1
        return tick

    def fade_steps(self, change):
        """As many as a blend between two latched commands needs: 1.875 |change| / limit is its time."""
        if math.isinf(self.limit):
            return self.fewest
        needed = 1.875 * change / self.limit / self.hold
        self.close_calls += 1e-7 < abs(needed - round(needed)) < 1e-5
        return max(self.fewest, math.ceil(needed - 1e-6) - 1)

    def arrive(self, tick):
        there = [c for c in self.coming if c["due"] <= self.now]
        if not there:
            return
        self.coming = [c for c in self.coming if c["due"] > self.now]
        alive = [c for c in there if self.now - c["observed"] < len(c["rows"])]
        best = max([c["observed"] for c in alive], default=-1)
        tick.refused = any(c["observed"] > best for c in there if c not in alive)
        if not alive:
            return
        newest = max(alive, key=lambda c: c["observed"])
        self.coming = [c for c in self.coming if c["observed"] > newest["observed"]]
        age = self.now - newest["observed"]
        tick.latency = age
        self.in_force = newest["observed"]
        fresh = newest["rows"][age:]
        if len(newest["rows"]) == 1:
            self.plan = [(row, True) for row in fresh]
        else:
            tick.blend_steps = self.join(fresh)
            tick.seam = bool(self.sent)
            self.fade = None

    def join(self, new):
        """Replace the plan by a blend into the new stream; its steps."""
        steps, plan = self.shortest([row for row, _ in self.plan], new) if self.sent else (0, list(new))
        self.plan = [(row, i >= steps) for i, row in enumerate(plan)]
        return steps

    def shortest(self, prior, new):
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
            if best is None or (best[0] > self.step and peak < best[0]):
                self.close_calls += best is not None and best[0] - peak < 1e-6
                best = peak, n, plan
            elif best[0] > self.step:
                self.close_calls += peak - best[0] < 1e-6
            if peak <= self.step:
                break
        return best[1], best[2]

    def blended(self, n, prior, new):
        last = self.sent[-1]
        plan = [list(row) for row in new]
        for k in range(len(last)):
            for i in range(n):
                before = prior[i][k] if n <= len(prior) else last[k]
                alpha = smooth((i + 1) / (n + 1))
                plan[i][k] = (1 - alpha) * before + alpha * new[i][k]
        return plan


def measured(commands, hold):
    """Per control step the rate of the change that ends there."""
    past = [np.asarray(c, dtype=np.float64) for c in commands]
    return [0.0, *(float(np.abs(b - a).max()) / hold for a, b in itertools.pairwise(past))]
