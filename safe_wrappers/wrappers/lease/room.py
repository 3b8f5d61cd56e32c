"""Room: the clearance that a lease is granted from, read from a constraint or by the user's function."""

import copy
import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.watchdog.leases import longest_lease, longest_lease_of_room
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Constraint, non_negative, positive
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import constraint_from

Array = NDArray[np.float64]

ClearanceFunction = Callable[[gym.Env[Any, Any]], tuple[ArrayLike, ArrayLike]]
"""The user's own: takes the env, returns clearances (m) and the approach speeds towards them (m/s), shapes (k,)."""


class Room:
    """How long a command may stay in force from here.

    Args:
        env: What is wrapped.
        clearance: A constraint with `approach(plant)` (clearances and approach speeds), any other constraint with a
            `value(plant)` and a `closing_speed`, or the user's function.
        braking: Verified lower bound on the deceleration, m/s^2; None takes the constraint's own.
        acceleration: Largest approach acceleration of any command, m/s^2.
        closing_speed: The fastest that the constraint's value may fall, in its unit per second, stopping distance
            and all, under any command.
        top_speed: Bound on the approach speed, m/s; None for none.
        localisation: Bound on the error of the clearance, m.
        margin: Clearance to be kept at rest, m.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        clearance: Constraint | dict[str, Any] | ClearanceFunction,
        *,
        braking: float | None,
        acceleration: float | None,
        closing_speed: float | None,
        top_speed: float | None,
        localisation: float,
        margin: float,
    ) -> None:
        self._env = env
        is_constraint = isinstance(clearance, dict) or hasattr(clearance, "rows")
        if not is_constraint and (isinstance(clearance, type) or not callable(clearance)):
            raise ConfigurationError(
                "clearance is a constraint, such as sw.Clearance(...), or a function of the env that returns the "
                f"clearance in m and the approach speed in m/s; got {clearance!r}"
            )
        # A copy: a filter may hold the same one, and a constraint remembers what it saw on its plant.
        self.constraint: Any = copy.deepcopy(constraint_from(clearance)) if is_constraint else None
        self._function: Any = None if is_constraint else clearance
        self._localisation = non_negative("localisation", localisation, "m")
        self._margin = non_negative("margin", margin, "m")
        self._approach = hasattr(self.constraint, "approach")
        if self.constraint is None or self._approach:
            self._braking = self._declared_braking(braking)
            if acceleration is None:
                raise ConfigurationError(
                    "acceleration is missing: the largest approach acceleration that any command may cause, in "
                    "m/s^2; 0 only for a machine that cruises at constant speed"
                )
            self._acceleration = non_negative("acceleration", acceleration, "m/s^2")
            self._top_speed = np.inf if top_speed is None else positive("top_speed", top_speed, "m/s")
            if closing_speed is not None:
                raise ConfigurationError(
                    "closing_speed is for constraints whose value is all that is known; here the approach speed is "
                    "measured: give acceleration (and top_speed)"
                )
            if self._approach:
                self._add_own_reserve()
            return
        name = type(self.constraint).__name__
        if not hasattr(self.constraint, "value"):
            raise ConfigurationError(
                f"{name} has no value(plant), so no room that a lease could be made from"
            )
        if closing_speed is None:
            raise ConfigurationError(
                f"{name} does not say how fast it is approached: give closing_speed, the fastest that its value may "
                "fall, in its unit per second"
            )
        if any(given is not None for given in (braking, acceleration, top_speed)):
            raise ConfigurationError(
                f"the value of {name} counts braking already: give closing_speed alone, without braking, "
                "acceleration and top_speed"
            )
        self._closing_speed = positive("closing_speed", closing_speed, "the constraint's unit per second")
        self._add_own_reserve()

    def bind(self, plant: Plant) -> None:
        """Resolve the constraint's names."""
        self._plant = plant
        if hasattr(self.constraint, "bind"):
            self.constraint.bind(plant)

    def reset(self) -> None:
        """Forget the episode, and let the constraint refuse what only a state can show."""
        if hasattr(self.constraint, "reset"):
            self.constraint.reset()
        if hasattr(self.constraint, "check"):
            self._plant.observe()
            self.constraint.check(self._plant)

    def approach(self) -> tuple[Array, Array]:
        """Clearances (m) and approach speeds (m/s) as they are now, reserves not taken off, shapes (k,).

        Only where they are measured: by a constraint with `approach`, or by the user's function.
        """
        if self.constraint is not None:
            self._plant.observe()
        return self._read()

    @property
    def braking(self) -> dict[str, float]:
        """What a stop takes, as the laws of `control.leases` want it; only where the approach is measured."""
        return {"braking": self._braking, "localisation": self._localisation, "margin": self._margin}

    @property
    def driving(self) -> dict[str, float]:
        """What any command may cause until then, likewise."""
        return {"acceleration": self._acceleration, "top_speed": self._top_speed}

    def longest_lease(self, delays_s: float) -> float:
        """The longest lease from here, s; zero or less: revoke.

        NaN where a reading is not finite: revoke in any case. inf where nothing is near: there are no clearances,
        or a constraint's value is inf.

        Args:
            delays_s: All delays beside the lease, s.
        """
        if self.constraint is not None:
            self._plant.observe()
        if self.constraint is not None and not self._approach:
            room = np.asarray(self.constraint.value(self._plant), dtype=np.float64)
            room = room[room != np.inf]
            if not np.isfinite(room).all():
                return math.nan
            room = room - self._margin - self._localisation
            return _least(longest_lease_of_room(room, self._closing_speed, delays_s))
        clearance, speed = self._read()
        if not (np.isfinite(clearance).all() and np.isfinite(speed).all()):
            return math.nan
        leases = longest_lease(
            clearance,
            speed,
            self._braking,
            delays_s,
            localisation=self._localisation,
            margin=self._margin,
            acceleration=self._acceleration,
            top_speed=self._top_speed,
        )
        return _least(leases)

    def _add_own_reserve(self) -> None:
        """A constraint's clearance or value is to the limit itself: its own reserve is not taken off yet."""
        self._localisation += float(getattr(self.constraint, "state_error", 0.0))
        self._margin += float(getattr(self.constraint, "margin", 0.0))

    def _read(self) -> tuple[Array, Array]:
        if self.constraint is not None:
            clearance, speed = self.constraint.approach(self._plant)
            return clearance, speed
        answer = self._function(self._env)
        try:
            clearance, speed = (np.atleast_1d(np.asarray(x, dtype=np.float64)) for x in answer)
            clearance, speed = np.broadcast_arrays(clearance, speed)
        except (TypeError, ValueError):
            raise ConfigurationError(
                "the clearance function must return two things of the same shape, clearances in m and approach "
                f"speeds in m/s; got {answer!r}"
            ) from None
        return clearance, speed

    def _declared_braking(self, braking: float | None) -> float:
        own = getattr(self.constraint, "braking", None)
        if braking is None and own is None:
            raise ConfigurationError(
                "braking is missing: a verified lower bound on the deceleration of the fallback, in m/s^2"
            )
        declared: Any = own if braking is None else braking
        return positive("braking", declared, "m/s^2")


def _least(leases: Array) -> float:
    """Nothing near: no end to it."""
    return float(leases.min(initial=np.inf))
