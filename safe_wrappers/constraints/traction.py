"""Traction: keep driven wheels on the stable side of a traction curve that nobody knows."""

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control.vehicle import FrictionEstimate, slip_ratio, slip_window
from safe_wrappers.errors import Array, ConfigurationError, name_list, non_negative, positive
from safe_wrappers.filter.constraint import Constraint, HalfSpaces, Memory
from safe_wrappers.plants.mujoco.driven_wheels import DrivenWheels
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Plant

_CAUTION = 0.5  # standard deviations of the believed peak's slip by which the limit stays below it
_NOISE = 0.02  # standard deviation of a measured friction coefficient while the slip stands still
_NOISE_PER_SLIP = 1.5  # what a slip that changed within the interval adds to it
_LEAST_LIMIT = 0.1  # share of `max_slip` that is always allowed: without any slip there is no force
_SPEED_ERROR_FACTOR = 2.0  # times the recent error of the predicted ground speed: kept free for the next
_SPEED_ERROR_IGNORED = 0.05  # share of the room below the limit that such an error may take uncounted
_SPEED_ERROR_FADE = 0.9  # share of such an error that still counts one control step later
_LEAST_SHARE = 0.3  # of the slip that must be along the heading: the force across is not measured
_UNBOUNDED = 1e9  # stands for the control of an actuator without limits
_LEAST_LOAD = 0.05  # share of the largest load seen below which a wheel counts as in the air
_MOST_FRICTION = 3.0  # force over load beyond which something else than the ground held the wheel


@dataclass
class TractionMemory:
    """What Traction remembers of an episode; arrays of shape (wheels,), before the last control."""

    estimate: FrictionEstimate
    rate: Array | None  # turning rates, rad/s; None: nothing was measured
    time: float  # s
    ground: Array  # speeds of the ground below, m/s
    slip: Array  # slip ratios along the heading
    across: Array  # and across it
    load: Array  # forces on the ground, N
    most_load: Array  # the largest so far, N
    faster: Array  # recent error of the predicted ground speed, upwards, m/s
    slower: Array  # downwards, m/s
    ahead: Array  # by how much the ground speed is predicted to change, m/s
    traction: Array  # force of the ground in the last control step, N
    present: Array  # of the ground at its end, N


@dataclass
class Traction(Constraint):
    """Keep the slip ratio of every driven wheel within `max_slip`, and below where its ground's curve seems to peak.

    Forces of the ground and the peak of each wheel's traction curve are estimated
    (`control/vehicle.py`); the limit is half a standard deviation below the peak, or `max_slip`.

    Best effort: a wheel whose ground stays the same for a control step ends it within the limit, up to what its force
    and its speed over ground change otherwise than predicted. Where the ground, the load or the other wheels'
    commands change, the slip overshoots for one to three steps; that is not flagged, and `slip/ratio` shows it.

    Args:
        wheels: Names of the wheels' hinges; each must be driven by motors on that joint and nothing else.
        max_slip: Largest slip ratio, normalised, in (0, 1).
        friction: Lower bound on the peak friction coefficient under every wheel, > 0, whose force is counted on at
            once; too high a bound lets wheels spin. None: no bound.
        regularization: Speed below which slip is counted against it, m/s.
        margin: Slip kept free below the limit.

    Source: appendix "Wheel slip ratio and friction boundaries".
    """

    wheels: Sequence[str]
    max_slip: float = 0.15
    friction: float | None = None
    regularization: float = 0.5
    margin: float = 0.0

    info_keys: ClassVar[tuple[str, ...]] = (keys.SLIP_RATIO, keys.SLIP_MU_ESTIMATE)

    def __post_init__(self) -> None:
        self.wheels = name_list("wheels", self.wheels, "joint names", least=0)
        self.max_slip = positive("max_slip", self.max_slip, "slip, in (0, 1)")
        if self.max_slip >= 1.0:
            raise ConfigurationError(f"max_slip is a normalised slip ratio in (0, 1), got {self.max_slip}")
        if self.friction is not None:
            self.friction = positive("friction", self.friction, "force per load")
        self.regularization = positive("regularization", self.regularization, "m/s")
        self.margin = non_negative("margin", self.margin, "slip")
        if self.margin >= self.max_slip:
            raise ConfigurationError(f"margin must be below max_slip = {self.max_slip}, got {self.margin}")

    def setup(self, plant: Plant) -> None:
        super().setup(
            require_mujoco(plant, "Traction needs a MujocoPlant: it reads the wheels from the model")
        )
        if self.plant.delay_s > 0.0:
            raise ConfigurationError(
                "Traction measures the ground's force from how the wheels answer, which a plant with a delay "
                f"({self.plant.delay_s} s) predicts instead; use delay_s=0"
            )
        self._wheels = DrivenWheels(self.plant, self.wheels)
        self.constants = self._wheels.wheel
        self._response = self.constants.response(float(self.plant.model.opt.timestep), self.plant.substeps)
        slip, friction = np.zeros(len(self.wheels)), self._start().estimate.mean
        self.report |= {keys.SLIP_RATIO: slip, keys.SLIP_MU_ESTIMATE: friction}

    def _start(self) -> TractionMemory:
        n = len(self.wheels)
        return TractionMemory(FrictionEstimate(n), None, math.nan, *(np.zeros(n) for _ in range(10)))

    def observe(self, memory: Memory) -> None:
        """Take the state and measure what the last control step showed."""
        before = memory.get("traction") or self._start()
        seen = memory["traction"] = self.seen = replace(before, estimate=copy.deepcopy(before.estimate))
        self._measure(seen)
        self.report[keys.SLIP_RATIO] = seen.slip.copy()
        self.report[keys.SLIP_MU_ESTIMATE] = seen.estimate.mean

    def _measure(self, seen: TractionMemory) -> None:
        rate, ground, sideways = self._wheels.motion()
        published = self.plant.published()
        assert published is not None  # there is no delay
        load = self._wheels.loads(self.plant.attribute("model"), published)
        if not np.isfinite(rate + ground + sideways + load).all():
            seen.rate = None
            return
        wheel = self.constants.radius * rate
        slip = slip_ratio(wheel, ground, self.regularization)
        faster = np.maximum(np.maximum(np.abs(ground), np.abs(wheel)), self.regularization)
        across = np.abs(sideways) / faster
        elapsed, seen.time = self.plant.time - seen.time, self.plant.time
        held = math.isclose(elapsed, self.plant.control_dt, rel_tol=1e-6)
        again = elapsed == 0.0 and bool((rate == seen.rate).all())  # keeps what was measured
        if seen.rate is None or not (held or again):
            # Nothing before it, or a clock that was set: no held control led from that state to this one.
            seen.ahead, seen.traction, seen.present = (np.zeros_like(rate) for _ in range(3))
            seen.faster, seen.slower = np.zeros_like(rate), np.zeros_like(rate)
        elif held:
            error = ground - seen.ground - seen.ahead
            seen.faster = np.maximum(error, _SPEED_ERROR_FADE * seen.faster)
            seen.slower = np.maximum(-error, _SPEED_ERROR_FADE * seen.slower)
            seen.ahead = ground - seen.ground
            torque = published.qfrc_actuator[self._wheels.dofs]
            seen.traction = self.constants.traction(self._response, seen.rate, rate, torque)
            # Below the regularisation the number is no slip ratio, and says nothing about the curve.
            self._learn(ground, slip, across, load, rolls=faster > self.regularization)
        seen.rate, seen.ground, seen.slip, seen.across, seen.load = rate, ground, slip, across, load
        at, spread = seen.estimate.peak_slip
        limit = np.minimum(self.max_slip, at - _CAUTION * spread) - self.margin
        # Along and across share one curve: what slides sideways already is not left for driving and braking.
        limit = np.sqrt(np.maximum(limit**2 - across**2, 0.0))
        self._limit = np.maximum(limit, _LEAST_LIMIT * self.max_slip)
        speed, radius = ground + seen.ahead, self.constants.radius
        low, high = slip_window(speed, self._limit, self.regularization)
        self._window = low / radius, high / radius
        # A ground speed above the prediction is slip of a braked wheel, one below it of a driven wheel.
        below, above = _kept_free(seen.faster, speed - low), _kept_free(seen.slower, high - speed)
        self._reserve = below / radius, above / radius

    def _learn(
        self, ground: Array, slip: Array, across: Array, load: Array, rolls: NDArray[np.bool_]
    ) -> None:
        """Give the estimate the slip and the friction of the last control step, where it showed any."""
        seen = self.seen
        mean_load, along = 0.5 * (load + seen.load), 0.5 * (slip + seen.slip)
        total = np.hypot(along, 0.5 * (across + seen.across))
        seen.most_load = np.maximum(seen.most_load, mean_load)
        seen.estimate.travel(np.abs(ground) * self.plant.control_dt)
        loaded = np.minimum(load, seen.load) > _LEAST_LOAD * seen.most_load
        usable = loaded & rolls & (seen.traction * along > 0.0) & (np.abs(along) > _LEAST_SHARE * total)
        # The force points against the sliding: its part along the heading is the part of the slip there.
        part = np.where(usable, np.abs(along) / np.where(usable, total, 1.0), 1.0)
        friction = np.abs(seen.traction) / (part * np.where(loaded, mean_load, 1.0))
        usable &= friction <= _MOST_FRICTION
        noise = (_NOISE + _NOISE_PER_SLIP * np.abs(slip - seen.slip)) / part
        seen.estimate.update(total, friction, np.where(usable, noise, np.inf))
        # What was measured is the interval's mean; where the slip went on growing, so did the force. From nothing to
        # its end a slip is at most twice its mean; a slip that has changed its sign in between shows no more.
        now = np.where(slip * along > 0.0, np.minimum(np.abs(slip), 2.0 * np.abs(along)), 0.0)
        risen = seen.traction * seen.estimate.rise(np.abs(along), now)
        seen.present = np.where(seen.traction * along > 0.0, risen, seen.traction)

    def _torques(self, rates: Array, counted_on: Array) -> Array:
        """The torques that take the wheels to given rates by the end of the hold, if the ground gives a force."""
        assert self.seen.rate is not None
        coasting = self._response.decay * self.seen.rate
        return np.asarray((rates - coasting) / self._response.gain + self.constants.radius * counted_on)

    def rows(self) -> HalfSpaces:
        """Two per wheel, for driving and braking torque, where the drive could exceed them."""
        if self.seen.rate is None:  # says nothing, and a row that is not a number fails
            return HalfSpaces(np.full((1, self.plant.lower.size), np.nan), np.full(1, np.nan))
        effect = self._wheels.effect
        carried = 0.0 if self.friction is None else self.friction * self.seen.load
        most = self._torques(self._window[1], np.maximum(self.seen.present, carried))
        least = self._torques(self._window[0], np.minimum(self.seen.present, -carried))
        low, high = self.plant.acting_range
        low, high = np.maximum(low, -_UNBOUNDED), np.minimum(high, _UNBOUNDED)
        ends = [end(effect * low, effect * high).sum(axis=1) for end in (np.minimum, np.maximum)]
        # What is kept back for an error of the prediction is kept as far as the drive can: it is no limit by itself.
        gain = self._response.gain
        most = np.maximum(most - self._reserve[1] / gain, np.minimum(most, ends[0]))
        least = np.minimum(least + self._reserve[0] / gain, np.maximum(least, ends[1]))
        # From outside the window, as fast back as the drive can: no more can be asked for.
        outside = np.abs(self.seen.slip) > self._limit
        most = np.where(outside, np.maximum(most, ends[0]), most)
        least = np.where(outside, np.minimum(least, ends[1]), least)
        # Negated, so that a row that is not a number is kept, and fails, instead of being left out.
        up, down = ~(ends[1] <= most), ~(ends[0] >= least)
        normals = np.concatenate([effect[up], -effect[down]])
        return HalfSpaces(normals, np.concatenate([most[up], -least[down]]))

    def proposals(self, control: Array | None) -> Iterable[Array]:
        """The control that brakes the vehicle as the slip limit allows it; other actuators at zero."""
        if control is not None:
            return ()
        if self.seen.rate is None:
            return (np.zeros_like(self.plant.lower),)
        speed = self.seen.ground + self.seen.ahead
        low, high = self._window[0] + self._reserve[0], self._window[1] - self._reserve[1]
        wanted = np.where(speed > 0.0, low, high)
        # No farther than to a standstill: past it the wheel would drive the other way.
        wanted = np.where(speed > 0.0, np.maximum(wanted, 0.0), np.minimum(wanted, 0.0))
        torque = self._torques(wanted, self.seen.present)
        return (np.linalg.lstsq(self._wheels.effect, torque, rcond=None)[0],)


def _kept_free(error: Array, room: Array) -> Array:
    """Of the room that the limit leaves, for an error of the predicted ground speed, both m/s."""
    counted = _SPEED_ERROR_FACTOR * np.maximum(error - _SPEED_ERROR_IGNORED * room, 0.0)
    return np.minimum(counted, (1.0 - _LEAST_LIMIT) * room)
