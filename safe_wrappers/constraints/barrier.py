"""Barrier: the user's own h on the plant's state."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.constraints.constraint import HalfSpaces, Promise, non_negative, positive
from safe_wrappers.control.cbf import (
    cbf_rows,
    lie_derivatives,
    linear_decay,
    numerical_gradient,
    relative_degree,
)
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]


@dataclass
class Barrier:
    """Keep `h(x) >= 0` by `Lf h + Lg h u >= -alpha (h - margin) + curvature * hold / 2`.

    What it promises: in continuous time (and at samples short against 1/alpha) the set `h >= margin` is
    invariant while the row is feasible. Between the samples of a held control it is proved only if `curvature`
    bounds how fast h' can fall: then `h(t) >= (h - margin)(1 - alpha t) + margin >= 0` for the whole hold. With
    the default of 0 that reserve is missing, and `margin` is what covers it. Feasibility depends on your h and
    your actuators: infeasible steps are counted and the fallback runs. Hence best effort.

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

    promise: Promise = "best effort"

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

    def value(self, plant: Plant) -> Array:
        """H at the plant's state, shape (1,)."""
        return np.array([float(self.h(plant.state))])

    def rows(self, plant: Plant) -> HalfSpaces:
        """The barrier condition as one half-space."""
        x = plant.state
        h = float(self.h(x))
        drift, effect = lie_derivatives(self._gradient(x), plant.f, plant.g)
        room = h - self.margin
        decay = self.alpha(room) if callable(self.alpha) else linear_decay(room, self.alpha)
        normal, offset = cbf_rows(drift, effect, decay - 0.5 * self.curvature * plant.hold_s)
        return HalfSpaces(normal[None, :], offset.reshape(1))

    def _gradient(self, x: Array) -> Array:
        if self.gradient is None:
            return numerical_gradient(self.h, x)
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
        if np.abs(self._gradient(x) @ plant.g).max(initial=0.0) > 1e-9:
            return
        drift = getattr(plant, "drift", lambda _: plant.f)
        matrix = getattr(plant, "effect", lambda _: plant.g)
        # The gradient may vanish at this very state (h = 1 - v^2 at rest): look around it before refusing.
        spread = np.random.default_rng(0).normal(size=(8, x.size)) * 0.1
        degrees = [relative_degree(self.h, drift, matrix, x + s) for s in spread]
        if 1 not in degrees:
            higher = min((d for d in degrees if d is not None), default=None)
            found = f"its relative degree is {higher}" if higher else "no control acts on it"
            raise ConfigurationError(
                f"the control does not act on h' ({found}), so a barrier row cannot keep it: put the "
                "braking distance into h (for example D - v^2 / (2 a_brake)), or use Clearance"
            )
