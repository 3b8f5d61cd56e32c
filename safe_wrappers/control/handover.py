"""The handover from one stream of held commands to the next: blends, and whether a machine bears them.

A stream is a policy's commands for the next control steps, shape (n, m): one per step, in action units. With
`rate_limit` in action units per second no two neighbours differ by more than `rate_limit * control_dt`. A machine's
own limits are judged along the curve that a drive follows which interpolates the commands: matched ends say nothing
about what lies between them.

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.errors import Array, ConfigurationError, positive

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

BLENDS: Final = ("smoothstep", "quintic")

LOOK_BACK: Final = 3
"""Commands before a seam that its blend continues: position, first and second difference."""
SMOOTHSTEP_PEAKS: Final = (1.0, 1.875, 10.0 / math.sqrt(3.0), 60.0)
"""Largest magnitude of the smoothstep and its derivatives."""
_ROUND_UP: Final = 1.0 + 1e-12
"""Blend times are lengthened by this factor, so that rounding never makes them too short."""
_ROUNDING: Final = 1.0 + 1e-9
"""Limits count as kept up to this factor."""


def smoothstep(s: ArrayLike) -> Array:
    """alpha(s) = 6 s^5 - 15 s^4 + 10 s^3 for s in [0, 1], 0 before it and 1 after it, of any shape."""
    s = np.clip(np.asarray(s, dtype=np.float64), 0.0, 1.0)
    near = np.minimum(s, 1.0 - s)  # alpha(1 - s) = 1 - alpha(s): the half without cancellation
    half = near**3 * (near * (6.0 * near - 15.0) + 10.0)
    return np.asarray(np.where(s <= 0.5, half, 1.0 - half))


def shortest_blend(change: Array | float, limit: Array | float, derivative: int = 1) -> Array:
    """Shortest smoothstep, s, between two constant commands under a limit on a derivative by time (1 to 3).

    `(peak |change| / limit)^(1 / derivative)`, rounded up; the limit is in action units per s^derivative.
    """
    time = (SMOOTHSTEP_PEAKS[derivative] * np.abs(change) / limit) ** (1.0 / derivative)
    return np.asarray(time * _ROUND_UP)


class Seam(NamedTuple):
    """Transition from one stream into the next."""

    plan: Array  #: commands from the seam on, shape (n, m): the blend, then the new stream bit for bit
    steps: int  #: control steps of the blend: the first `steps` commands are mixed
    limited: NDArray[np.bool_]  #: which commands were rate-limited in addition to the blend, shape (n,)


def join(
    sent: Array,
    prior: Array,
    new: Array,
    control_dt: float,
    *,
    blend: str = "smoothstep",
    fewest: int = 0,
    rate_limit: Array | float = np.inf,
    low: Array | float = -np.inf,
    high: Array | float = np.inf,
    accepts: Callable[[int], bool] | None = None,
) -> Seam | None:
    """The shortest blend from what was sent into a new stream that keeps the rate limit.

    If no blend that ends inside the new stream keeps it, the one that exceeds it least is rate-limited step by step.

    Args:
        sent: The latest commands, oldest first, shape (k, m), k >= 0; with none there is no seam.
        prior: Remaining commands of the present stream, shape (p, m), p >= 0.
        new: The new stream for the next steps, shape (n, m), n >= 1.
        control_dt: Control interval, s.
        blend: "smoothstep" mixes the streams, the prior one held at the last command unless it lasts for the whole
            blend. "quintic" bridges from the last command to the new stream with matching first and second
            derivatives at both ends, clipped to the box.
        fewest: Least number of steps of the blend (fewer only if the new stream is shorter).
        rate_limit: Largest ``|du/dt|``, action units per second: of every component, or of each, shape (m,).
        low: Lower bound of the action box, for the bridge, shape (m,) or a number.
        high: Upper bound.
        accepts: Whether a blend of so many steps will do, 0 for none, asked from the shortest on of those that keep
            the rate limit and that the box does not cut. If none will do, the result is None.
    """
    step = np.asarray(rate_limit * control_dt)
    if not len(sent):
        plan, limited = limit_rate(new, None, step)
        return Seam(plan, 0, limited)
    first = min(fewest, len(new) - 1)
    if accepts is None and first == 0 and len(new) > 1 and (np.abs(new[0] - sent[-1]) > step).any():
        first = 1
    chosen, least = None, np.inf
    for steps in range(first, len(new)):
        made = _mixed(sent, prior, new, steps) if blend == "smoothstep" else _bridged(sent, new, steps)
        boxed = made if blend == "smoothstep" else np.clip(made, low, high)
        plan = np.concatenate([boxed, new[steps:]])
        way = np.diff(np.concatenate([sent[-1:], plan[: steps + 1]]), axis=0)
        peak = float((np.abs(way) / step).max())
        if accepts is None:
            if chosen is None or peak < least:
                chosen, least = (plan, steps), peak
            if peak <= 1.0:
                break
        elif peak <= 1.0 and np.allclose(made, boxed, rtol=1e-9, atol=1e-12) and accepts(steps):
            chosen = plan, steps
            break
    if chosen is None:
        return None
    plan, limited = limit_rate(chosen[0], sent[-1], step)
    return Seam(plan, chosen[1], limited)


def limit_rate(commands: Array, before: Array | None, step: Array | float) -> tuple[Array, NDArray[np.bool_]]:
    """Limit the difference of neighbouring commands, shape (n, m), to `step`; returns them and which were changed.

    The step is in action units, a number or shape (m,), and may be infinite; `before` is the command before the
    first, shape (m,), or None. Commands within the limit are returned bit for bit.
    """
    limited = np.zeros(len(commands), dtype=bool)
    whole = commands if before is None else np.concatenate([before[None], commands])
    if len(whole) < 2 or (np.abs(np.diff(whole, axis=0)) <= step).all():
        return commands, limited
    kept = commands.copy()
    last = kept[0] if before is None else before
    for i in range(len(kept)):
        held = np.clip(kept[i], last - step, last + step)
        limited[i] = (held != kept[i]).any()
        kept[i] = last = held
    return kept, limited


def _phases(steps: int) -> Array:
    """Normalised time of the commands of a blend, which arrives one command after them, shape (steps,)."""
    return np.asarray(np.arange(1.0, steps + 1.0) / (steps + 1.0))


@lru_cache(maxsize=256)
def _basis(steps: int) -> Array:
    """Contribution of each boundary value of a quintic of unit duration to each command, (steps, 6)."""
    from scipy.interpolate import BPoly  # here: SciPy takes a while to import

    unit = np.eye(6)
    return np.asarray(BPoly.from_derivatives([0.0, 1.0], [unit[:3], unit[3:]])(_phases(steps)))


def _mixed(sent: Array, prior: Array, new: Array, steps: int) -> Array:
    """The commands of a blend of two streams, shape (steps, m)."""
    before = prior[:steps] if steps <= len(prior) else sent[-1]
    return np.asarray(before + smoothstep(_phases(steps))[:, None] * (new[:steps] - before))


def _bridged(sent: Array, new: Array, steps: int) -> Array:
    """The commands of a bridge, shape (steps, m). Derivatives are per control step, of which it lasts one more."""
    given = np.stack([*_backward_differences(sent), *(d[steps] for d in _stream_derivatives(new))])
    return np.asarray(_basis(steps) @ (given * (steps + 1.0) ** np.array([0, 1, 2, 0, 1, 2])[:, None]))


def _backward_differences(sent: Array) -> list[Array]:
    """The last command with its first and second backward differences, shape (m,) each; 0 if too little was sent."""
    return [
        np.diff(sent[-k - 1 :], n=k, axis=0)[0] if len(sent) > k else np.zeros_like(sent[-1])
        for k in range(LOOK_BACK)
    ]


def _stream_derivatives(new: Array) -> list[Array]:
    """A stream, shape (n, m), with its first and second central differences, per control step."""
    second = np.zeros_like(new)
    if len(new) > 2:
        second[1:-1] = np.diff(new, n=2, axis=0)
    return [new, np.gradient(new, axis=0) if len(new) > 1 else np.zeros_like(new), second]


def bridge(sent: Array, new: Array, steps: int, control_dt: float) -> PPoly:
    """The quintic of `join` that bridges `steps` commands: of the time since the last command, s, values (m,)."""
    from scipy.interpolate import BPoly, PPoly

    per_step = control_dt ** -np.arange(3.0)[:, None]
    before = np.stack(_backward_differences(sent)) * per_step
    after = np.stack([d[steps] for d in _stream_derivatives(new)]) * per_step
    bernstein = BPoly.from_derivatives([0.0, (steps + 1) * control_dt], [before, after])
    return PPoly.from_bernstein_basis(bernstein)


def _extremes(curve: PPoly, derivative: int) -> list[Array]:
    """For each component the times at which a derivative by time may be extreme between the ends."""
    found = curve.derivative(derivative + 1).roots(discontinuity=False, extrapolate=False)
    return [times[np.isfinite(times)] for times in found]


def peaks(curve: PPoly, derivative: int) -> Array:
    """Largest magnitude of a derivative by time (0 to 3) over a whole curve, shape (m,): at its ends or extremes."""
    times = [np.concatenate([curve.x, inner]) for inner in _extremes(curve, derivative)]
    return np.array([np.abs(curve(t, derivative)[:, j]).max() for j, t in enumerate(times)])


def hermite_spline(positions: Array, spacing: float) -> PPoly:
    """The cubic Hermite spline through positions (k, m), `spacing` apart, with central differences as rates."""
    from scipy.interpolate import CubicHermiteSpline

    rates = np.gradient(positions, spacing, axis=0)
    return CubicHermiteSpline(spacing * np.arange(len(positions)), positions, rates)


def knot_torque_step(inertia: Array, spacing: float, positions: Array) -> Array:
    """Torque steps M(q) dq'' at the inner knots of `hermite_spline`, N m, shape (k - 2, m), for M (k - 2, m, m)."""
    bend = hermite_spline(positions, spacing).derivative(2)
    at_starts, at_ends = bend.c[-1], np.polyval(bend.c, spacing)
    jumps = at_starts[1:] - at_ends[:-1]
    return np.asarray((inertia @ jumps[:, :, None])[:, :, 0])


_UNITS: Final = {
    "velocity": "action units per s",
    "acceleration": "action units per s^2",
    "jerk": "action units per s^3",
    "torque": "N m",
    "torque_slew": "N m/s",
}


@dataclass(frozen=True)
class SeamLimits:
    """What a machine was measured to bear, for `ChunkHandover(limits=)`; what is None is not judged.

    Each is one number for all entries of a command, or one for each of them. Torques are for commands that are
    positions of joints: those which the joints need, by inverse dynamics of the env's MuJoCo model.

    Raises:
        ConfigurationError: A limit that is not positive, or none at all.
    """

    velocity: float | Sequence[float] | None = None  #: action units per s
    acceleration: float | Sequence[float] | None = None  #: action units per s^2
    jerk: float | Sequence[float] | None = None  #: action units per s^3
    torque: float | Sequence[float] | None = None  #: N m
    torque_slew: float | Sequence[float] | None = None  #: N m/s

    def __post_init__(self) -> None:
        for name, unit in _UNITS.items():
            object.__setattr__(self, name, _entries(f"limits.{name}", getattr(self, name), unit))
        if all(getattr(self, name) is None for name in _UNITS):
            raise ConfigurationError(f"limits has none; it takes {', '.join(_UNITS)}")

    def of(self, name: str, controls: int) -> Array:
        """A limit for each entry of a command, shape (controls,); infinite for none."""
        value = getattr(self, name)
        each = value if isinstance(value, tuple) else (math.inf if value is None else value,) * controls
        if len(each) != controls:
            raise ConfigurationError(f"limits.{name} has {len(each)} entries, a command {controls}")
        return np.array(each)

    @property
    def needs_dynamics(self) -> bool:
        """Whether torques are limited that only a model can tell."""
        return self.torque is not None or self.torque_slew is not None


def _entries(name: str, value: Any, unit: str) -> float | tuple[float, ...] | None:
    if value is None:
        return None
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(positive(name, one, unit) for one in value)
    return positive(name, value, unit)


class SeamCheck:
    """Whether quintic blends and chunks of m controls keep a machine's limits.

    Where `limits.needs_dynamics`, `torques` gives those that positions, velocities and accelerations of the joints
    take, N m, all of shape (k, m), and `inertia` the matrices of joint positions, shape (k, m, m), kg m^2.
    """

    def __init__(
        self,
        limits: SeamLimits,
        controls: int,
        control_dt: float,
        torques: Callable[[Array, Array, Array], Array] | None = None,
        inertia: Callable[[Array], Array] | None = None,
    ) -> None:
        self._control_dt, self._torques, self._inertia = control_dt, torques, inertia
        self._bounds = [limits.of(name, controls) for name in ("velocity", "acceleration", "jerk")]
        self._torque, self._slew = limits.of("torque", controls), limits.of("torque_slew", controls)

    def accepts(self, sent: Array, new: Array, steps: int) -> bool:
        """Whether a quintic of `join` that bridges `steps` commands keeps all limits up to its end.

        Torques are judged at every quarter of a control step, and where an acceleration is largest or smallest.
        """
        curve = bridge(sent, new, steps, self._control_dt)
        if any((peaks(curve, d) > bound * _ROUNDING).any() for d, bound in enumerate(self._bounds, 1)):
            return False
        if self._torques is None:
            return True
        grid = np.linspace(0.0, curve.x[-1], 4 * (steps + 1) + 1)
        times = np.unique(np.concatenate([grid, *_extremes(curve, 2)]))
        torque, passed = self._torques(*(curve(times, d) for d in range(3))), np.diff(times)[:, None]
        within = np.where(passed > 1e-9 * self._control_dt, passed, self._control_dt)
        slow = np.abs(np.diff(torque, axis=0)) <= self._slew * within * _ROUNDING
        return bool((np.abs(torque) <= self._torque * _ROUNDING).all() and slow.all())

    def bears_knots(self, knots: Array, spacing: float) -> bool:
        """Whether torque steps at the knots (k, m) of a cubic spline, `spacing` s apart, keep the torque's slew."""
        if self._inertia is None or len(knots) < 3:
            return True
        steps = knot_torque_step(self._inertia(knots[1:-1]), spacing, knots)
        return bool((self._slew * self._control_dt * _ROUNDING >= np.abs(steps)).all())

    def shortest_fade(self, change: Array) -> float:
        """The shortest smoothstep, s, that changes a held command by (m,) within the limits but those of torque."""
        return float(np.max([shortest_blend(change, bound, d) for d, bound in enumerate(self._bounds, 1)]))
