"""Barrier: the user's own h on the plant's state."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from safe_wrappers.checks import Array, non_negative, one_number, positive
from safe_wrappers.control import barriers as cbf
from safe_wrappers.control.numerics.projection import keeps_rows
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import BoundConstraint, Constraint, HalfSpaces, Memory
from safe_wrappers.filter.linearize import linearize
from safe_wrappers.plants.plant import Plant

_ROUNDING = 1e-9  # round-off, as a share of h's size: of its value and its gradient together
_NO_EFFECT = 1e-7  # error of differences, as a share of h's size and of the control's effect on the state


@dataclass
class Barrier(Constraint):
    """Keep `h(x) >= 0` by `Lf h + Lg h u >= -alpha (h - margin)`.

    Best effort: a held control that is not flagged keeps `h >= 0` at the half and at the end of the hold
    (AnalyticPlant) or at every physics substep (MujocoPlant), for a plant and an integration that are right.

    Args:
        h: Takes the plant's state (n,), returns a number, positive inside the safe set. The control must act on h'
            (relative degree one); this is checked at the first reset.
        alpha: Decay gain in 1/s, at most `1 / hold`.
        margin: Reserve for errors of state, model and integration, in units of h.

    Source: appendix "Lie derivatives and forward invariance" and footnote 1.
    """

    h: Callable[[Array], float]
    alpha: float = 1.0
    margin: float = 0.0

    def __post_init__(self) -> None:
        if not callable(self.h):
            raise ConfigurationError(f"h must be a function of the state, got {self.h!r}")
        self.alpha = positive("alpha", self.alpha, "1/s")
        self.margin = non_negative("margin", self.margin, "units of h")


class BoundBarrier(BoundConstraint, of=Barrier):
    """Barrier on a plant."""

    predicts: bool = True
    spec: Barrier

    def __init__(self, spec: Barrier, plant: Plant) -> None:
        plant.require_acceleration("Barrier")
        super().__init__(spec, plant)
        if spec.alpha * plant.control_dt > 1.0:
            crossing = f"alpha = {spec.alpha}/s lets h cross zero within one hold of {plant.control_dt} s"
            raise ConfigurationError(
                f"{crossing}; alpha must be at most 1/hold = {1.0 / plant.control_dt:g}/s"
            )
        self._degree_checked = False

    def observe(self, memory: Memory) -> None:
        self._row: HalfSpaces | None = None
        self._now = self._height(self.plant.state)

    def value(self) -> Array:
        return np.array([self._now])

    def _height(self, x: Array) -> float:
        return one_number("h", self.spec.h(x))

    def rows(self) -> HalfSpaces:
        if self._row is None:
            self._row = self._condition()
        return self._row

    def _condition(self) -> HalfSpaces:
        x = self.plant.state
        gradient = cbf.numerical_gradient(self._height, x)
        self._rounding = _ROUNDING * (abs(self._now) + max(map(abs, gradient.tolist()), default=0.0))
        decay = self.spec.alpha * (self._now - self.spec.margin)
        drift, effect = gradient @ self.plant.f, gradient @ self.plant.g
        return HalfSpaces(-effect[None, :], np.array([drift + decay]))

    def slack(self, control: Array) -> float:
        """Not measured: whether a control is admitted is all that is known."""
        return 0.0 if self.admits(control) else -np.inf

    def admits(self, control: Array) -> bool:
        """Whether the row holds and prediction keeps h through the hold (from outside: does not lose more)."""
        row = self.rows()
        kept = float(row.normals[0] @ control - row.offsets[0]) <= 0.0
        box = self.plant.lower, self.plant.upper
        if not kept and not keeps_rows(control, row.normals, row.offsets, *box):
            return False
        floor = min(self._now, 0.0) - self._rounding
        return all(self._height(x) >= floor for x in self.plant.path(control))

    def linearize(self, control: Array) -> HalfSpaces:
        self.rows()
        floor = min(self._now, 0.0)

        def slacks(u: Array) -> Array:
            heights = [self._height(x) - floor for x in self.plant.path(u)]
            return np.array(heights) if len(heights) <= 3 else np.array([heights[-1], min(heights)])

        return linearize(slacks, control, self.plant.lower, self.plant.upper)

    def check(self) -> None:
        """Refuse an h on which no control acts at first order, at the first state or anywhere near."""
        if self._degree_checked:
            return
        x = self.plant.state
        self._degree_checked = True
        h = self._height(x)
        if not np.isfinite([*x, h]).all():
            raise ConfigurationError(f"the first state must be finite and h of it too; got {x}, h = {h}")
        if cbf.acts(cbf.numerical_gradient(self._height, x), self.plant.g, h, _NO_EFFECT):
            return
        # The gradient may vanish at this very state (h = 1 - v^2 at rest): look around it before refusing.
        spread = np.random.default_rng(0).normal(size=(8, x.size)) * 0.1
        f, g = self.plant.drift, self.plant.effect
        degrees = [cbf.relative_degree(self._height, f, g, x + s) for s in spread]
        if 1 not in degrees:
            higher = min((d for d in degrees if d is not None), default=None)
            found = f"its relative degree is {higher}" if higher else "no control acts on it"
            raise ConfigurationError(
                f"the control does not act on h' ({found}), so a barrier row cannot keep it: put the "
                "braking distance into h (for example D - v^2 / (2 a_brake)), or use Clearance"
            )
