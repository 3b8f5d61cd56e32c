"""A machine's measured limits, and whether a blend keeps them between its ends.

Source: appendix "Smooth Trajectories and Bumpless Transfer": matched ends say nothing about what lies between them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from safe_wrappers.checks import Array, positive
from safe_wrappers.control.handover.curves import BlendCurve, Motion, knot_torque_step
from safe_wrappers.control.handover.smoothstep import SMOOTHSTEP_PEAK_RATE
from safe_wrappers.errors import ConfigurationError

Entries = float | Sequence[float] | None
Inertia = Callable[[Array], Array]
"""Of joint positions, shape (k, m): their inertia matrices, shape (k, m, m), kg m^2."""
Torques = Callable[[Motion], Array]
"""Of a motion of the joints: the torques that it takes, shape (k, m), N m."""

_UNITS: Final = {
    "velocity": "action units per s",
    "acceleration": "action units per s^2",
    "jerk": "action units per s^3",
    "torque": "N m",
    "torque_slew": "N m/s",
}
_DERIVATIVES: Final = {"velocity": 1, "acceleration": 2, "jerk": 3}
_SMOOTHSTEP_PEAKS: Final = (1.0, SMOOTHSTEP_PEAK_RATE, 10.0 / math.sqrt(3.0), 60.0)
"""Largest magnitude of the smoothstep and its derivatives."""
_ROUNDING: Final = 1.0 + 1e-9


@dataclass(frozen=True)
class SeamLimits:
    """What a machine was measured to bear, for `ChunkHandover(limits=)`; what is None is not judged.

    Each is one number for all entries of a command, or one for each of them.

    Attributes:
        velocity: Action units per s.
        acceleration: Action units per s^2.
        jerk: Action units per s^3.
        torque: Of commands that are positions of joints: that which the joint needs, by inverse dynamics of the env's
            MuJoCo model, N m.
        torque_slew: N m/s, likewise.

    Raises:
        ConfigurationError: A limit that is not positive, or none at all.
    """

    velocity: Entries = None
    acceleration: Entries = None
    jerk: Entries = None
    torque: Entries = None
    torque_slew: Entries = None

    def __post_init__(self) -> None:
        for name, unit in _UNITS.items():
            object.__setattr__(self, name, _entries(f"limits.{name}", getattr(self, name), unit))
        if all(getattr(self, name) is None for name in _UNITS):
            raise ConfigurationError(f"limits has none; it takes {', '.join(_UNITS)}")

    def of(self, name: str, controls: int) -> Array | None:
        """A limit for each entry of a command, shape (controls,); None for none."""
        value = getattr(self, name)
        if value is None:
            return None
        each = value if isinstance(value, tuple) else (value,) * controls
        if len(each) != controls:
            raise ConfigurationError(f"limits.{name} has {len(each)} entries, a command {controls}")
        return np.array(each)

    @property
    def needs_dynamics(self) -> bool:
        """Whether torques are limited that only a model can tell."""
        return self.torque is not None or self.torque_slew is not None


class SeamCheck:
    """Whether quintic blends and chunks keep limits.

    Args:
        limits: Of the machine.
        controls: m, entries of a command.
        control_dt: Control interval, s.
        torques: Needed where `limits.needs_dynamics`.
        inertia: Likewise.
    """

    def __init__(
        self,
        limits: SeamLimits,
        controls: int,
        control_dt: float,
        torques: Torques | None = None,
        inertia: Inertia | None = None,
    ) -> None:
        self._control_dt, self._torques, self._inertia = control_dt, torques, inertia
        every = {name: limits.of(name, controls) for name in _UNITS}
        found = {d: every[name] for name, d in _DERIVATIVES.items()}
        self._bounds: Mapping[int, Array] = {d: bound for d, bound in found.items() if bound is not None}
        none = np.full(controls, math.inf)
        self._torque = none if every["torque"] is None else every["torque"]
        self._slew = none if every["torque_slew"] is None else every["torque_slew"]

    def accepts(self, sent: Array, new: Array, steps: int) -> bool:
        """Whether a quintic of `seams.join` that bridges `steps` commands keeps all limits up to its end."""
        curve = BlendCurve.of(sent, new, steps, self._control_dt)
        if any((curve.peak(d) > bound * _ROUNDING).any() for d, bound in self._bounds.items()):
            return False
        return self._torques is None or self._bears(curve.motion(), self._torques)

    def bears_knots(self, knots: Array, spacing: float) -> bool:
        """Whether the torque steps at a cubic spline's knots, M times the acceleration's, keep the torque's slew.

        Args:
            knots: Positions, shape (k, m).
            spacing: From one to the next, s.
        """
        if self._inertia is None or len(knots) < 3:
            return True
        steps = knot_torque_step(self._inertia(knots[1:-1]), spacing, knots)
        return bool((self._slew * self._control_dt * _ROUNDING >= np.abs(steps)).all())

    def shortest_fade(self, change: Array) -> float:
        """Duration of the shortest smoothstep between two held commands, s: `peak |change| / T^d` within each limit.

        Args:
            change: |u_new - u_prior|, shape (m,). A torque that inverse dynamics would tell is not asked for.
        """
        spans = [(_SMOOTHSTEP_PEAKS[d] * change / bound) ** (1.0 / d) for d, bound in self._bounds.items()]
        return float(np.max(spans, initial=0.0))

    def _bears(self, motion: Motion, torques: Torques) -> bool:
        torque, passed = torques(motion), np.diff(motion.times)[:, None]
        within = np.where(passed > 1e-9 * self._control_dt, passed, self._control_dt)
        slow = np.abs(np.diff(torque, axis=0)) <= self._slew * within * _ROUNDING
        return bool((np.abs(torque) <= self._torque * _ROUNDING).all() and slow.all())


def _entries(name: str, value: Any, unit: str) -> float | tuple[float, ...] | None:
    if value is None:
        return None
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(positive(name, one, unit) for one in value)
    return positive(name, value, unit)
