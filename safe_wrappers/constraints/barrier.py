"""Barrier: the user's own h on the plant's state."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.filtering.cbf import (
    acts,
    cbf_rows,
    lie_derivatives,
    linear_decay,
    numerical_gradient,
    relative_degree,
)
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import HalfSpaces, Promise, non_negative, positive
from safe_wrappers.filter.linearize import cut
from safe_wrappers.filter.projection import keeps_rows
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]

_ROUNDING = 1e-9
"""Less is round-off, as a share of h's size: of its value and its gradient together."""
_NO_EFFECT = 1e-7
"""A control that acts on h' by less, as a share of h's size and of the control's effect on the state, is looked at
more closely: differences leave as much."""


@dataclass
class Barrier:
    """Keep `h(x) >= 0` by `Lf h + Lg h u >= -alpha (h - margin) + curvature * hold / 2`.

    What it promises: in continuous time the set `h >= margin` is invariant while the row is feasible. A held
    control is checked by prediction as well: h must not be negative at the half and at the end of the hold
    (AnalyticPlant; the end by Runge-Kutta and by one Euler step), or at every physics substep (MujocoPlant);
    where it is, the constraint is linearised anew about the refused control. So a control that is not flagged
    keeps h at those instants, for a plant and an integration that are right; `margin` covers what is not (state
    error, another integrator). `curvature`, a bound on -h'' under a held control, adds that reserve to the row
    itself. Feasibility depends on your h and your actuators: infeasible steps are counted and the fallback
    runs. Hence best effort.

    Args:
        h: Takes the plant's state (n,), returns a number, positive inside the safe set. Its relative degree
            must be one: the control must act on h', so a position under a force needs its braking distance in
            h (see `Clearance`). This is checked at the first reset.
        gradient: Takes the state, returns dh/dx (n,). None differentiates by central differences.
        alpha: Decay gain in 1/s (`alpha * h`), at most `1 / hold`; or an increasing function of h, with
            alpha(0) = 0, in h units per second (extended class K).
        margin: Reserve for state error and model error, in units of h.
        curvature: Bound on -h'' while a control is held, in units of h per s^2.

    Source: appendix "Lie derivatives and forward invariance" and footnote 1.
    """

    h: Callable[[Array], float]
    gradient: Callable[[Array], ArrayLike] | None = None
    alpha: float | Callable[[float], float] = 1.0
    margin: float = 0.0
    curvature: float = 0.0

    promise: Promise = field(default="best effort", init=False)
    needs_acceleration: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not callable(self.h):
            raise ConfigurationError(f"h must be a function of the state, got {self.h!r}")
        if self.gradient is not None and not callable(self.gradient):
            raise ConfigurationError(
                f"gradient must be a function of the state or None, got {self.gradient!r}"
            )
        if callable(self.alpha):
            if self.alpha(0.0) != 0.0 or self.alpha(1.0) <= 0.0 or self.alpha(-1.0) >= 0.0:
                raise ConfigurationError(
                    "alpha as a function must be extended class K: alpha(0) = 0, increasing; got "
                    f"alpha(-1), alpha(0), alpha(1) = {self.alpha(-1.0)}, {self.alpha(0.0)}, {self.alpha(1.0)}"
                )
        else:
            self.alpha = positive("alpha", self.alpha, "1/s")
        self.margin = non_negative("margin", self.margin, "units of h")
        self.curvature = non_negative("curvature", self.curvature, "units of h per s^2")

    def bind(self, plant: Plant) -> None:
        """Refuse a decay that outruns the hold interval."""
        if not callable(self.alpha) and self.alpha * plant.hold_s > 1.0:
            raise ConfigurationError(
                f"alpha = {self.alpha}/s lets h cross zero within one hold of {plant.hold_s} s; "
                f"alpha must be at most 1/hold = {1.0 / plant.hold_s:g}/s"
            )
        self._degree_checked = False
        self._stamp: int | None = None

    def value(self, plant: Plant) -> Array:
        """H at the plant's state, shape (1,)."""
        return np.array([self._height(plant.state)])

    def _height(self, x: Array) -> float:
        value = self.h(x)
        if isinstance(value, float):  # np.float64 is one: the common case
            return float(value)
        h = np.asarray(value, dtype=np.float64)
        if h.size != 1:
            raise ConfigurationError(f"h must return one number, got an array of shape {h.shape}")
        return float(h.reshape(()))

    def rows(self, plant: Plant) -> HalfSpaces:
        """The barrier condition as one half-space."""
        stamp = getattr(plant, "stamp", None)
        if stamp is None or stamp != self._stamp:
            self._stamp, self._row = stamp, self._condition(plant)
        return self._row

    def _condition(self, plant: Plant) -> HalfSpaces:
        x = plant.state
        self._now = self._height(x)
        gradient = self._gradient(x)
        self._rounding = _ROUNDING * (abs(self._now) + float(np.abs(gradient).max(initial=0.0)))
        drift, effect = lie_derivatives(gradient, plant.f, plant.g)
        room = self._now - self.margin
        decay = self.alpha(room) if callable(self.alpha) else linear_decay(room, self.alpha)
        normal, offset = cbf_rows(drift, effect, decay - 0.5 * self.curvature * plant.hold_s)
        return HalfSpaces(normal[None, :], offset.reshape(1))

    def admits(self, plant: Plant, control: Array) -> bool:
        """Whether the row holds and prediction keeps h through the hold (from outside: does not lose more)."""
        row = self.rows(plant)
        excess = float(row.normals[0] @ control - row.offsets[0])
        if not excess <= 0.0 and not keeps_rows(control, row.normals, row.offsets, plant.lower, plant.upper):
            return False
        path = getattr(plant, "path", None)
        if path is None:
            return True
        floor = min(self._now, 0.0) - self._rounding
        return all(self._height(x) >= floor for x in path(control))

    def cut(self, plant: Plant, control: Array) -> HalfSpaces:
        """The predicted h, linearised about a refused control."""
        self.rows(plant)
        path = getattr(plant, "path", None)
        if path is None:
            return HalfSpaces.none(control.size)
        floor = min(self._now, 0.0)

        def slacks(u: Array) -> Array:
            heights = [self._height(x) - floor for x in path(u)]
            return np.array(heights) if len(heights) <= 3 else np.array([heights[-1], min(heights)])

        return cut(slacks, control, plant.lower, plant.upper)

    def _gradient(self, x: Array) -> Array:
        if self.gradient is None:
            return numerical_gradient(self._height, x)
        dh = np.asarray(self.gradient(x), dtype=np.float64)
        if dh.shape != x.shape:
            raise ConfigurationError(f"gradient must return the shape of the state {x.shape}, got {dh.shape}")
        return dh

    def check(self, plant: Plant) -> None:
        """Refuse an h on which no control acts at first order, at the first state or anywhere near."""
        if self._degree_checked:
            return
        x = plant.state
        self._degree_checked = True
        if not np.isfinite(x).all() or not np.isfinite(self._height(x)):
            raise ConfigurationError(
                f"the first state must be finite and h of it too; got {x}, h = {self._height(x)}"
            )
        if self.gradient is not None:
            given, differences = self._gradient(x), numerical_gradient(self._height, x)
            size = abs(self._height(x)) + np.abs(differences).max()
            if np.abs(given - differences).max() > 1e-2 * size:
                raise ConfigurationError(
                    f"gradient does not fit h: at the first state it gives {given}, differences give {differences}"
                )
        if acts(self._gradient(x), plant.g, self._height(x), _NO_EFFECT):
            return
        drift = getattr(plant, "drift", lambda _: plant.f)
        matrix = getattr(plant, "effect", lambda _: plant.g)
        # The gradient may vanish at this very state (h = 1 - v^2 at rest): look around it before refusing.
        spread = np.random.default_rng(0).normal(size=(8, x.size)) * 0.1
        degrees = [relative_degree(self._height, drift, matrix, x + s) for s in spread]
        if 1 not in degrees:
            higher = min((d for d in degrees if d is not None), default=None)
            found = f"its relative degree is {higher}" if higher else "no control acts on it"
            raise ConfigurationError(
                f"the control does not act on h' ({found}), so a barrier row cannot keep it: put the "
                "braking distance into h (for example D - v^2 / (2 a_brake)), or use Clearance"
            )
