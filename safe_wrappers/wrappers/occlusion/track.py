"""Track: something that moves, and what is known of how it moves."""

from collections.abc import Callable, Sequence, Sized
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import mujoco
import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive, settings_from
from safe_wrappers.control.estimation.covariance import checked_covariance
from safe_wrappers.control.estimation.tracks import Motion
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.serialize import plain_numbers


@dataclass
class Track:
    """What an `OcclusionPenalty` follows: bodies of the model, or points that the env publishes, and how they move.

    At a reset the track starts from the true position plus noise of `start_position_std`, and from the mean velocity.

    Args:
        bodies: Name of a body, or a pattern ("car*", "car[012]") for every body that fits, in the model's order.
        published: Instead of bodies: name of an attribute of the env, positions of shape (k, 2) or (k, 3), m.
        acceleration_noise: Intensity q of the white acceleration noise, m^2/s^3: after t seconds unseen it adds
            q t^3 / 3 to the variance of a position. A number, one per coordinate (0 along a coordinate that does not
            wander), or a matrix, d x d. It has no default.
        reversion_s: Time constant with which the velocity goes back to `mean_velocity`, s; None: it does not.
        mean_velocity: m/s, one per coordinate; None: zeros.
        start_position_std: m, a number or one per coordinate.
        start_velocity_std: m/s, a number or one per coordinate.
        turn_noise: Of a velocity that turns at a rate of its own (a coordinated turn), intensity of the white noise
            in that rate's derivative, rad^2/s^3: after t seconds unseen it adds `turn_noise` t to the rate's
            variance. None: a velocity that does not turn. In the plane alone.
        start_turn_std: Of such a turn rate at a reset, where its mean is 0, rad/s.

    Raises:
        ConfigurationError: Bodies and published points at once, or neither; a number or matrix out of its range.
    """

    bodies: str | None = None
    published: str | None = None
    acceleration_noise: Any = None
    reversion_s: float | None = None
    mean_velocity: Sequence[float] | None = None
    start_position_std: Any = 0.1
    start_velocity_std: Any = 0.5
    turn_noise: float | None = None
    start_turn_std: float = 0.5

    def __post_init__(self) -> None:
        if (self.bodies is None) == (self.published is None):
            given = f"bodies={self.bodies!r}, published={self.published!r}"
            raise ConfigurationError(
                f"a track follows bodies by name or pattern, or published points; got {given}"
            )
        name = self.published if self.bodies is None else self.bodies
        if not isinstance(name, str):
            raise ConfigurationError(f"bodies and published are names, got {name!r}")
        if self.acceleration_noise is None:
            noise = "the intensity of its white acceleration noise in m^2/s^3"
            raise ConfigurationError(f"acceleration_noise is missing: {noise} (0: velocity stays)")
        check_fields(self, positive, ["reversion_s"], "s")
        check_fields(self, non_negative, ["turn_noise"], "rad^2/s^3")
        check_fields(self, non_negative, ["start_turn_std"], "rad/s")
        for name in ("acceleration_noise", "mean_velocity", "start_position_std", "start_velocity_std"):
            setattr(self, name, plain_numbers(getattr(self, name)))

    def motion(self, coordinates: int) -> Motion:
        """The motion model for d coordinates."""
        mean = 0.0 if self.mean_velocity is None else self.mean_velocity
        velocity = _each("mean_velocity", mean, coordinates, "m/s", signed=True)
        reversion_s = np.inf if self.reversion_s is None else self.reversion_s
        return Motion(
            _intensity(self.acceleration_noise, coordinates), reversion_s, velocity, self.turn_noise
        )

    def start(self, coordinates: int, size: int) -> Array:
        """Standard deviations of a state at a reset: position, velocity and, as a fifth, turn rate; shape (size,)."""
        stds = np.zeros(size)
        stds[:coordinates] = _each("start_position_std", self.start_position_std, coordinates, "m")
        velocity = _each("start_velocity_std", self.start_velocity_std, coordinates, "m/s")
        stds[coordinates : 2 * coordinates] = velocity
        if self.turn_noise is not None:
            stds[2 * coordinates :] = self.start_turn_std
        return stds

    def data(self) -> dict[str, Any]:
        """Plain data, from which it can be made again."""
        return asdict(self)


def _each(name: str, given: Any, coordinates: int, unit: str, signed: bool = False) -> Array:
    """One number per coordinate."""
    try:
        values = np.asarray(given, dtype=np.float64)
        values = np.array(np.broadcast_to(values, coordinates))
    except (TypeError, ValueError):
        wanted = f"a number or {coordinates} numbers (one per coordinate) in {unit}"
        raise ConfigurationError(f"{name} is {wanted}, got {given!r}") from None
    if not np.isfinite(values).all():
        raise ConfigurationError(f"{name} must be finite, in {unit}, got {given!r}")
    for value in () if signed else values:
        non_negative(name, value, unit)
    return values


def _intensity(given: Any, coordinates: int) -> Array:
    if isinstance(given, list) and any(isinstance(row, list) for row in given):
        return checked_covariance("acceleration_noise", given, coordinates)
    return np.diag(_each("acceleration_noise", given, coordinates, "m^2/s^3"))


def track_from(given: Any) -> Track:
    """A track itself, or rebuilt from the dict of a recorded one."""
    if isinstance(given, Track | dict):
        return settings_from(Track, given, "a track")
    example = f"sw.occlusion.Track({given!r}, acceleration_noise=0.1)"
    raise ConfigurationError(f"expected a Track, such as {example} (m^2/s^3); got {given!r}")


class Tracked(NamedTuple):
    """One thing that is tracked."""

    track: Track  # which it belongs to
    name: str  # the body's, or the attribute's with an index
    body: int  # in the model; -1 for a published point


def tracked_things(
    model: mujoco.MjModel, tracks: Sequence[Track], published: Callable[[Track], Sized]
) -> list[Tracked]:
    """All that the tracks follow, in their order."""
    things: list[Tracked] = []
    there = {model.body(b).name: b for b in range(1, model.nbody) if model.body(b).name}
    for track in tracks:
        if track.bodies is None:
            things += [Tracked(track, f"{track.published}[{i}]", -1) for i in range(len(published(track)))]
            continue
        found = [Tracked(track, name, b) for name, b in there.items() if fnmatchcase(name, track.bodies)]
        if not found:
            known = ", ".join(there) or "none"
            raise UnknownNameError(f"the model has no body {track.bodies!r}; it has: {known}")
        things += found
    names = [thing.name for thing in things]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigurationError(f"each thing is tracked once; these are named twice: {', '.join(twice)}")
    return things
