"""The seam between two streams of held commands: the blend from one into the other.

A stream is a policy's commands for the next control steps, shape (n, m): one per step, in action units. With
`rate_limit` in action units per second no two neighbours differ by more than `rate_limit * control_dt`.

Source: appendix "Smooth Trajectories and Bumpless Transfer", whose bounds are for continuous commands.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.smoothstep import smoothstep

Blend = Literal["smoothstep", "quintic"]
BLENDS: Final = ("smoothstep", "quintic")

LOOK_BACK: Final = 3
"""Commands before a seam that its blend continues: position, first and second difference."""


@dataclass(frozen=True, slots=True)
class Seam:
    """Transition from one stream into the next.

    Attributes:
        plan: The commands from the seam on, shape (n, m): the blend, then the new stream bit for bit.
        steps: Control steps of the blend: the first `steps` commands are mixed.
        limited: Which commands were rate-limited in addition to the blend, shape (n,).
    """

    plan: Array
    steps: int
    limited: NDArray[np.bool_]


def join(
    sent: Array,
    prior: Array,
    new: Array,
    control_dt: float,
    *,
    blend: Blend = "smoothstep",
    fewest: int = 0,
    rate_limit: Array | float = np.inf,
    low: Array | float = -np.inf,
    high: Array | float = np.inf,
    accepts: Callable[[int], bool] | None = None,
) -> Seam | None:
    """The shortest blend from what was sent into a new stream that keeps the rate limit.

    "smoothstep" mixes the two streams, the prior one held at the last command unless it lasts for the whole blend.
    "quintic" bridges from the last command to the new stream with matching first and second derivatives at both ends,
    clipped to the box. If no blend that ends inside the new stream keeps the limit,
    the one that exceeds it least is rate-limited step by step.

    Args:
        sent: The latest commands, oldest first, shape (k, m), k >= 0; with none there is no seam.
        prior: Remaining commands of the present stream, shape (p, m), p >= 0.
        new: The new stream for the next steps, shape (n, m), n >= 1.
        control_dt: Control interval, s.
        blend: See above.
        fewest: Least number of steps of the blend (fewer only if the new stream is shorter).
        rate_limit: Largest ``|du/dt|``, action units per second: of every component, or of each, shape (m,).
        low: Action box, for the bridge, shape (m,) or a number.
        high: Likewise.
        accepts: Whether a blend of so many steps will do, 0 for none, asked from the shortest on of those that keep
            the rate limit and that the box does not cut. If none will do, the result is None.
    """
    step = np.asarray(rate_limit * control_dt)
    if not len(sent):
        plan, limited = limit_rate(new, None, step)
        return Seam(plan, 0, limited)
    fewest = min(fewest, len(new) - 1)
    uncut: NDArray[np.bool_] = np.ones(len(new), dtype=bool)
    if accepts is None and fewest == 0 and (np.abs(new[0] - sent[-1]) <= step).all():
        candidates, first = new[None, :], 0
    else:
        first = max(fewest, 1) if accepts is None and len(new) > 1 else fewest
        if blend == "smoothstep":
            candidates = _mixed(sent, prior, new, first)
        else:
            bridges = _bridged(sent, new, first)
            candidates = np.clip(bridges, low, high)
            uncut = np.asarray(np.isclose(bridges, candidates, rtol=1e-9, atol=1e-12).all(axis=(1, 2)))
    peaks = _peaks(candidates, sent[-1], first, step)
    kept = np.flatnonzero(peaks <= 1.0)
    chosen: int | None = int(kept[0]) if kept.size else int(np.argmin(peaks))
    if accepts is not None:
        chosen = next((int(c) for c in kept if uncut[c] and accepts(first + int(c))), None)
    if chosen is None:
        return None
    steps = first + chosen
    plan = np.concatenate([candidates[chosen, :steps], new[steps:]])
    plan, limited = limit_rate(plan, sent[-1], step)
    return Seam(plan, steps, limited)


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


def _peaks(candidates: Array, before: Array, first: int, step: Array) -> Array:
    """The largest difference inside each blend, in units of the largest allowed one, shape (c,)."""
    start = np.broadcast_to(before, (len(candidates), 1, before.size))
    steps = (np.abs(np.diff(np.concatenate([start, candidates], axis=1), axis=1)) / step).max(axis=2)
    mixed = np.arange(steps.shape[1]) <= first + np.arange(len(candidates))[:, None]
    return np.asarray(np.where(mixed, steps, 0.0).max(axis=1))


def _phases(steps: int, longest: int) -> Array:
    """Normalised time at every step of a blend of `steps` steps, shape (longest + 1,); 1 from its end on."""
    return np.asarray(np.minimum((np.arange(longest + 1) + 1.0) / (steps + 1.0), 1.0))


@lru_cache(maxsize=256)
def _weights(first: int, longest: int) -> Array:
    """The new stream's weight at every step of every candidate blend, shape (c, longest + 1)."""
    weights = np.array([smoothstep(_phases(n, longest)) for n in range(first, longest + 1)])
    weights.flags.writeable = False
    return weights


@lru_cache(maxsize=256)
def _basis(first: int, longest: int) -> Array:
    """Contribution of each boundary value of a quintic of unit duration at every step, (c, longest + 1, 6)."""
    from scipy.interpolate import BPoly  # here: SciPy takes a while to import

    unit = np.eye(6)
    phases = np.array([_phases(n, longest) for n in range(first, longest + 1)])
    weights = np.asarray(BPoly.from_derivatives([0.0, 1.0], [unit[:3], unit[3:]])(phases))
    weights.flags.writeable = False
    return weights


def _mixed(sent: Array, prior: Array, new: Array, first: int) -> Array:
    """Every candidate blend of the two streams, shape (c, n, m)."""
    n = len(new)
    weight = _weights(first, n - 1)[:, :, None]
    moving = np.concatenate([prior[:n], np.broadcast_to(sent[-1], (max(n - len(prior), 0), sent.shape[1]))])
    lengths = np.arange(first, n)[:, None, None]
    before = np.where(lengths <= len(prior), moving, sent[-1])
    return np.asarray(np.where(weight < 1.0, before + weight * (new - before), new))


def _bridged(sent: Array, new: Array, first: int) -> Array:
    """Every candidate bridge, shape (c, n, m). Derivatives are per control step: n steps last n + 1 of them."""
    n = len(new)
    ends = np.arange(first, n)
    at_start, at_end = backward_differences(sent, 3), stream_derivatives(new)
    lasts = (ends + 1.0)[:, None]
    given = [np.broadcast_to(d, (len(ends), d.size)) * lasts**k for k, d in enumerate(at_start)]
    given += [d[ends] * lasts**k for k, d in enumerate(at_end)]
    bridged = _basis(first, n - 1) @ np.stack(given, axis=1)
    return np.asarray(np.where((np.arange(n) < ends[:, None])[:, :, None], bridged, new))


def backward_differences(sent: Array, order: int) -> list[Array]:
    """The last command and its first backward differences, `order` in all, each of shape (m,), per control step.

    Zero where too little was sent.
    """
    return [
        np.diff(sent[-k - 1 :], n=k, axis=0)[0] if len(sent) > k else np.zeros_like(sent[-1])
        for k in range(order)
    ]


def stream_derivatives(new: Array) -> list[Array]:
    """A stream, shape (n, m), with its first and second central differences, per control step."""
    second = np.zeros_like(new)
    if len(new) > 2:
        second[1:-1] = np.diff(new, n=2, axis=0)
    return [new, np.gradient(new, axis=0) if len(new) > 1 else np.zeros_like(new), second]
