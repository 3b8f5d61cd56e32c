"""RoundTripCeiling: how long a remote operator's round trip may be; and the watch over it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.constraints.clearance import Clearance
from safe_wrappers.control.watchdog.leases import longest_lease, round_trip_ceiling
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.constraint import Constraint, non_negative, positive
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import constraint_data, constraint_from
from safe_wrappers.wrappers.lease.room import ClearanceFunction, Room

Array = NDArray[np.float64]

_ROUNDING: Final = 1e-9
"""Control units times normals: a row that is missed by less is kept."""


@dataclass(frozen=True)
class RoundTripCeiling:
    """The longest round trip at which an operator may still be relied on, from the clearance and speed of the moment.

        T_RTT <= (D_clear - reserves - v^2 / (2 braking)) / v - (T_video + T_human + T_act)

    (`control.watchdog.leases.round_trip_ceiling`.) Beside it, and whatever the round trip: an operator's command is
    executed only if the machine can still stop by itself inside the clearance after it.

    Args:
        clearance: A constraint that measures its approach (`Clearance`), or a function of the env that returns
            clearances in m and approach speeds in m/s.
        braking: Verified lower bound on the deceleration of the local brake, m/s^2; a Clearance brings its own.
        acceleration: Largest approach acceleration that any command may cause, m/s^2; for the local stop.
        top_speed: Bound on the approach speed, m/s; None: none.
        video_s: T_video, exposure, encoding and display, without the downlink, s.
        human_s: T_human, the operator's reaction, s.
        act_s: T_act, until the full deceleration is there, s.
        localisation: Bound on the error of the clearance, m.
        margin: Clearance to be kept at rest, m; a constraint's own is added.
        longest_s: No ceiling is higher, s: an operator who is silent for longer loses authority at rest, too.
        release: Authority comes back only when the round trip is below this share of the ceiling.
    """

    clearance: Constraint | dict[str, Any] | ClearanceFunction
    braking: float | None = None
    acceleration: float | None = None
    top_speed: float | None = None
    video_s: float = 0.1
    human_s: float = 0.25
    act_s: float = 0.0
    localisation: float = 0.0
    margin: float = 0.0
    longest_s: float = 1.0
    release: float = 0.8

    def __post_init__(self) -> None:
        for name in ("video_s", "human_s", "act_s"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name), "s"))
        object.__setattr__(self, "longest_s", positive("longest_s", self.longest_s, "s"))
        release = positive("release", self.release, "a share of the ceiling")
        if release > 1.0:
            raise ConfigurationError(
                f"release is a share of the ceiling, above 0 and at most 1; got {release}"
            )
        object.__setattr__(self, "release", release)


def ceiling_from(given: Any) -> RoundTripCeiling | None:
    """A ceiling itself, from the dict of one, or None.

    Raises:
        ConfigurationError: None of these.
        UnknownNameError: A key that no ceiling has.
    """
    if given is None or isinstance(given, RoundTripCeiling):
        return given
    if isinstance(given, Mapping):
        known = [field.name for field in fields(RoundTripCeiling)]
        for key in given:
            if key not in known:
                raise UnknownNameError(f"a RoundTripCeiling has no {key!r}; it has {', '.join(known)}")
        return RoundTripCeiling(**given)
    raise ConfigurationError(f"ceiling is a RoundTripCeiling, the dict of one, or None; got {given!r}")


def ceiling_data(ceiling: RoundTripCeiling | None) -> dict[str, Any] | None:
    """The plain dict of a ceiling; a function stays one."""
    if ceiling is None:
        return None
    data = {field.name: getattr(ceiling, field.name) for field in fields(RoundTripCeiling)}
    given = data["clearance"]
    data["clearance"] = constraint_data(given) if hasattr(given, "rows") else given
    return data


class RoundTripWatch:
    """Measures clearance and approach, and says whether the operator may be obeyed in the coming control step.

    Args:
        env: What is wrapped.
        ceiling: What is watched.
        plant: Bound to the env; for a constraint.
        hold_s: Control interval, s.

    Raises:
        ConfigurationError: A bound that is missing, or a constraint that does not measure its approach.
    """

    def __init__(
        self, env: gym.Env[Any, Any], ceiling: RoundTripCeiling, plant: Plant | None, hold_s: float
    ) -> None:
        measured = ceiling.clearance
        if isinstance(measured, dict) or hasattr(measured, "rows"):
            measured = constraint_from(measured)
            if not hasattr(measured, "approach"):
                raise ConfigurationError(
                    f"{type(measured).__name__} does not say how fast it is approached, which a ceiling is made "
                    "from: give a Clearance, or a function of the env that returns clearances in m and approach "
                    "speeds in m/s"
                )
        # Rows know nothing of reserves that are not their constraint's own, nor of a brake that is late.
        own = isinstance(measured, Clearance)
        self._rows = own and ceiling.act_s == 0.0
        reserves = {"localisation": ceiling.localisation, "margin": ceiling.margin}
        if isinstance(measured, Clearance):
            measured = replace(
                measured,
                braking=measured.braking if ceiling.braking is None else ceiling.braking,
                margin=measured.margin + ceiling.margin,
                state_error=measured.state_error + ceiling.localisation,
            )
            reserves = dict.fromkeys(reserves, 0.0)
        self._room = Room(
            env,
            measured,
            braking=None if own else ceiling.braking,
            acceleration=ceiling.acceleration,
            closing_speed=None,
            top_speed=ceiling.top_speed,
            **reserves,
        )
        self._ceiling, self._plant, self._hold_s = ceiling, plant, hold_s
        if self._room.constraint is not None:
            assert plant is not None
            self._room.bind(plant)

    def reset(self) -> None:
        """A new episode."""
        self._room.reset()

    def look(self) -> None:
        """Measure the clearance of the present state.

        Where it cannot be read as numbers there is no ceiling: `ceiling_s` is the lowest there is.
        """
        ceiling, room = self._ceiling, self._room
        clearance, speed = room.approach()
        self.readable = bool(np.isfinite(clearance).all() and np.isfinite(speed).all())
        if not self.readable:
            self.clearance_m, self.ceiling_s, self._stop_s = 0.0, -ceiling.longest_s, -math.inf
            return
        self.clearance_m = float(clearance.min(initial=math.inf))
        delays = {"video_s": ceiling.video_s, "human_s": ceiling.human_s, "act_s": ceiling.act_s}
        ceilings = round_trip_ceiling(clearance, speed, **delays, **room.braking)
        # What does not approach asks for no stop: what is left of its clearance is for `can_stop_after`.
        highest_s = float(ceilings[speed > 0.0].min(initial=math.inf))
        # The next look comes one control step from now.
        self.ceiling_s = min(max(highest_s - self._hold_s, -ceiling.longest_s), ceiling.longest_s)
        stops = longest_lease(clearance, speed, delays_s=ceiling.act_s, **room.braking, **room.driving)
        self._stop_s = float(stops.min(initial=math.inf))

    readable: bool
    """Whether clearance and speed were numbers."""
    clearance_m: float
    """The smallest, m, as `look` found it; inf where there is nothing near."""
    ceiling_s: float
    """The longest admissible round trip, s, within `longest_s` of 0."""

    def can_stop_after(self, command: Array) -> bool:
        """Whether the machine can stop by itself after a command for one control step.

        First by the declared accelerations, whatever the command is; else by the rows of a `Clearance`, which know
        how the machine answers this one. Where the brake is late (`act_s`), and with other readings, there is no
        else: next to the limit no command is admitted then, not even one that leads away.
        """
        if self._stop_s >= self._hold_s:
            return True
        if not (self._rows and self.readable):
            return False
        rows = self._room.constraint.rows(self._plant)
        return bool((rows.normals @ command <= rows.offsets + _ROUNDING).all())
