"""Barrier: the user's own h on the plant's state."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from safe_wrappers.control import barriers as cbf
from safe_wrappers.errors import Array, ConfigurationError, non_negative, one_number, positive
from safe_wrappers.filter.constraint import Constraint, HalfSpaces, Memory
from safe_wrappers.plants.plant import Plant, Trajectory

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

    rows_decide: ClassVar[bool] = True
    recovery_s: ClassVar[float] = math.inf  # the row asks for the recovery

    def __post_init__(self) -> None:
        if not callable(self.h):
            raise ConfigurationError(f"h must be a function of the state, got {self.h!r}")
        self.alpha = positive("alpha", self.alpha, "1/s")
        self.margin = non_negative("margin", self.margin, "units of h")

    def setup(self, plant: Plant) -> None:
        plant.require_acceleration("Barrier")
        super().setup(plant)
        if self.alpha * plant.control_dt > 1.0:
            crossing = f"alpha = {self.alpha}/s lets h cross zero within one hold of {plant.control_dt} s"
            raise ConfigurationError(
                f"{crossing}; alpha must be at most 1/hold = {1.0 / plant.control_dt:g}/s"
            )
        self._degree_checked = False

    def observe(self, memory: Memory) -> None:
        if not (memory or self._degree_checked):
            self._check_degree()
            self._degree_checked = True

    def _height(self, x: Array) -> float:
        return one_number("h", self.h(x))

    def h_along(self, path: Trajectory) -> Array:
        """Of every state."""
        return np.array([[self._height(x)] for x in path.states])

    def rows(self) -> HalfSpaces:
        """One row `Lf h + Lg h u >= -alpha (h - margin)`."""
        x = self.plant.state
        now, gradient = self._height(x), cbf.numerical_gradient(self._height, x)
        self.rounding = _ROUNDING * (abs(now) + max(map(abs, gradient.tolist()), default=0.0))
        decay = self.alpha * (now - self.margin)
        drift, effect = gradient @ self.plant.f, gradient @ self.plant.g
        return HalfSpaces(-effect[None, :], np.array([drift + decay]))

    def _check_degree(self) -> None:
        """Refuse an h on which no control acts at first order, at the first state or anywhere near."""
        x = self.plant.state
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
