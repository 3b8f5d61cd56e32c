"""EscapeClearance: for a point mass on two axes, out of the way of what moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.constraints.obstacles import (
    Disc,
    Discs,
    Plane,
    TrackedDiscs,
    distances,
    obstacles_from,
)
from safe_wrappers.control.backup.evasive_maneuvers import (
    Around,
    EvasiveManeuvers,
    Maneuver,
    least_left,
)
from safe_wrappers.errors import Array, ConfigurationError, check_fields, non_negative, positive
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.plants.mujoco.planar_point import nearest_first, planar_point
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Model, Plant, Trajectory

_EVERY = 2  # holds between the instants at which ways are checked
_GOING_S = (0.3, 0.8)  # for how long the manoeuvres go before they brake, s
_DIRECTIONS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
_RECOVERY_S = 0.4  # time constant, s, with which the way out of a violation must come clear
_BLENDS = (0.2, 0.4, 0.6, 0.8)  # shares of the way from a refused control to one that leaves a way out
_APPROACHED = 2  # how many of those are approached


@dataclass
class EscapeClearance(Constraint, Model):
    """Keep a point mass on two axes out of obstacles, moving ones above all, by keeping an escape open.

    A control is admitted if, held for one control step, it leaves a manoeuvre whose whole way keeps clear of where
    the obstacles may be by then. Manoeuvres brake at once, or go along one axis for 0.3 s or 0.8 s first.

    Best effort: from a state with a clear manoeuvre, the executed control leaves one, or the step is flagged; while
    every obstacle stays inside its declared bound, that manoeuvre keeps clear until the horizon. Ways are checked at
    every second control step, and estimates move (up to `margin` of that is not flagged).

    Args:
        body: Name of the body on its two slides along x and y, each with a force actuator of its own.
        obstacles: `TrackedDiscs`, `Discs`, and what stands still: `Disc`, `Plane`.
        radius: Of the machine around the body's origin, m.
        margin: Fixed protective distance, m.
        horizon_s: How far ahead, s: longer than the longest manoeuvre takes to come to rest.

    Raises:
        UnsupportedEnvError: At binding: no `MujocoPlant`, or the body is no point mass on two slides.

    Source: appendix "Relative degree and kinetic stopping insets", "Continuous Lyapunov and Riccati covariance
    dynamics".
    """

    body: str
    obstacles: Sequence[Any]
    radius: float = 0.0
    margin: float = 0.05
    horizon_s: float = 2.5

    smooth: ClassVar[bool] = False
    recovery_s: ClassVar[float] = 0.0  # counted along every way

    def __post_init__(self) -> None:
        self.obstacles = obstacles_from(self.obstacles, kinds=(TrackedDiscs, Discs, Disc, Plane))
        check_fields(self, non_negative, ("radius", "margin"), "m")
        self.horizon_s = positive("horizon_s", self.horizon_s, "s")
        for obstacle in self.obstacles:
            if isinstance(obstacle, Plane) and len(obstacle.point) > 2:
                raise ConfigurationError(f"obstacles are seen from above: give {obstacle!r} x and y alone")

    def setup(self, plant: Plant) -> None:
        hint = "EscapeClearance needs a MujocoPlant: it reads the point from the model"
        machine = require_mujoco(plant, hint)
        self._moving: list[Any] = [o for o in self.obstacles if _moves(o)]
        self._fixed = [o for o in self.obstacles if not _moves(o)]
        for obstacle in self._moving:
            if isinstance(obstacle, TrackedDiscs):
                obstacle.tracks(machine)
        super().setup(machine)
        self._point = point = planar_point(self.plant, np.inf, self.body)
        # What one hold makes of a state; x and y.
        self._hold = np.array([(a.low, a.high, a.drift, a.shift, a.keep, a.add) for a in point.axes]).T
        holds = int(np.ceil(self.horizon_s / self.plant.control_dt))
        longest = max(1, round(max(_GOING_S) / self.plant.control_dt))
        if holds <= longest:
            raise ConfigurationError(
                f"horizon_s = {self.horizon_s:g} s is too short for steps of {self.plant.control_dt:g} s: a "
                f"manoeuvre takes {longest} of them before it brakes"
            )
        bank = [Maneuver(0.0, 0.0, 0)]
        bank += [Maneuver(x, y, going) for x, y in _DIRECTIONS for going in range(1, longest + 1)]
        self._escapes = EvasiveManeuvers(point.axes, bank, np.arange(0, holds + 1, _EVERY))
        starts = [max(1, round(seconds / self.plant.control_dt)) for seconds in _GOING_S]
        self._usual = [0, *(bank.index(Maneuver(x, y, n)) for x, y in _DIRECTIONS for n in starts)]
        self._firsts_of = [0, *(bank.index(Maneuver(x, y, 1)) for x, y in _DIRECTIONS)]

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        return Trajectory(control, self.plant.state[None])

    def observe(self, memory: Memory) -> None:
        self._asked: list[tuple[Array, NDArray[np.intp]]] = []
        joints = self._point.joints
        self._position = self.plant.qpos[joints] + self._point.origin
        going_on, asked = None, memory.get("asked", ())
        if (
            asked
        ):  # the manoeuvre that is open after the executed control: of the nearest one that was asked about
            _, _, _, _, keep, add = self._hold
            velocity = keep * memory["velocity"] + add * self._acting(self._driven(memory["control"]))
            led_to = np.concatenate([v for v, _ in asked])
            best = np.concatenate([b for _, b in asked])
            going_on = int(best[((led_to - velocity) ** 2).sum(axis=1).argmin()])
        self._going_on = going_on
        memory["asked"] = self._asked
        memory["velocity"] = self._velocity = self.plant.qvel[joints]

    def clearance(self) -> Array:
        """Distance now, not along a manoeuvre, from every obstacle or the bound of where it may be, m, shape (n,)."""
        which, going_on = list(self._usual), self._going_on
        if going_on is not None:
            # The same way with one hold less to go: the manoeuvres of a direction are in the order of their lengths.
            shorter = going_on - 1 if self._escapes.manoeuvres[going_on].holds > 1 else 0
            which += [i for i in (going_on, shorter) if i not in which]
        self._open = np.array(which, dtype=np.intp)
        # A way after a held control begins one hold from now.
        times = self.plant.control_dt * np.concatenate([[0.0], 1.0 + self._escapes.instants])
        parts = [self._expected(o, times) for o in self._moving]
        none = np.zeros((times.size, 0, 2))
        centers = np.concatenate([none, *(c for c, _ in parts)], axis=1)
        halves = np.concatenate([none, *(h for _, h in parts)], axis=1)
        radii = [np.full(c.shape[1], o.radius) for (c, _), o in zip(parts, self._moving, strict=True)]
        sizes = np.concatenate([*radii, np.zeros(0)]) + self.radius
        offsets = np.maximum(np.abs(self._position - centers[0]) - halves[0], 0.0)
        moving = np.sqrt((offsets * offsets).sum(axis=1)) - sizes
        fixed = [distances(o, self._position[None], self.plant)[0] - self.radius for o in self._fixed]
        now = np.concatenate([moving, *fixed])
        self._around = Around(centers[1:], halves[1:], sizes, self._discs(), self._planes())
        # From outside, the violation must shrink along the way.
        outside = min(float(now.min(initial=np.inf)) - self.margin, 0.0)
        self._wanted = self.margin + outside * np.exp(-times[1:] / _RECOVERY_S)
        self._best: float | None = None
        return now

    def _discs(self) -> Array:
        """For `Around`."""
        discs = [o for o in self._fixed if not isinstance(o, Plane)]
        parts = [np.insert(o.centers(self.plant)[:, :2], 2, o.radius + self.radius, axis=1) for o in discs]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def _planes(self) -> Array:
        """For `Around`."""
        planes = [o for o in self._fixed if isinstance(o, Plane)]
        rows = [[*_flat(o.point), *_flat(o.normal), self.radius] for o in planes]
        return np.array(rows).reshape(-1, 5)

    def _expected(self, obstacle: Any, times: Array) -> tuple[Array, Array]:
        """Centres and half-widths of the boxes that hold them, shapes (k, n, 2)."""
        # Under a delay the state is predicted: so are the obstacles, to the same moment.
        if self.plant.delay_s:
            times = times + (self.plant.time - float(self.plant.attribute("data").time))
        if isinstance(obstacle, TrackedDiscs):
            centers, halves = obstacle.boxes(self.plant, times)
            return centers[..., :2], halves[..., :2]
        centers = obstacle.centers(self.plant)[:, :2]
        velocity = np.asarray(self.plant.attribute(obstacle.velocity_attribute), dtype=np.float64)[:, :2]
        moved = centers + times[:, None, None] * velocity
        return moved, np.zeros_like(moved)

    def _held(self, controls: Array) -> tuple[Array, Array]:
        """Positions and velocities after held controls, shapes (..., 2)."""
        _, _, drift, shift, keep, add = self._hold
        held = self._acting(controls)
        position = self._position + drift * self._velocity + shift * held
        return position, keep * self._velocity + add * held

    def _acting(self, controls: Array) -> Array:
        return np.asarray(np.minimum(np.maximum(controls, self._hold[0]), self._hold[1]))

    def _slacks(self, controls: Array) -> Array:
        """What every way out after each of some held controls (c, 2) leaves, wanted >= 0, shape (c, manoeuvres)."""
        position, velocity = self._held(controls)
        x, y = self._escapes.paths(position, velocity, self._open)
        left = least_left(x, y, self._around, self._wanted)
        self._asked.append((velocity, self._open[left.argmax(axis=1)]))
        return left

    def _driven(self, control: Array) -> Array:
        return np.asarray(control)[self._point.actuators]

    def h_along(self, path: Trajectory) -> Array:
        """What the best way out after a held control leaves, m; now the distance from what is around."""
        if path.control is None:
            return self.clearance()[None]
        left = float(self._slacks(self._driven(path.control)[None]).max())
        if left < 0.0:
            left -= self._needed()
        return np.array([[left + self.margin]])

    def _needed(self) -> float:
        """What a way out must leave: 0, or the best that there is while new estimates use up only the margin."""
        if self._best is None:
            self._best = float(self._slacks(self._firsts()).max())
        return self._best if -self.margin < self._best < 0.0 else 0.0

    def _backup(self) -> Array:
        """Braking where it leaves a way out, else the first control of the one that keeps farthest away."""
        firsts = self._firsts()
        left = self._slacks(firsts).max(axis=1)
        best = firsts[0 if left[0] >= 0.0 else int(left.argmax())]
        return self._point.control(np.zeros(self.plant.model.nu), best)

    def _firsts(self) -> Array:
        """First controls of the manoeuvres: braking, and each direction; shape (5, 2)."""
        return np.array([self._escapes.first(i, self._velocity) for i in self._firsts_of])

    def proposals(self, control: Array | None) -> list[Array]:
        """Admissible controls near a refused one, the nearest first."""
        if control is None:
            return [self._backup()]
        asked, firsts = self._driven(control), self._firsts()
        left = self._slacks(firsts).max(axis=1)
        self._best = float(left.max())
        needed = self._needed()
        good = nearest_first(firsts[left >= needed], asked)
        if needed == 0.0 and len(good):
            ends = good[:_APPROACHED]
            tried = [asked + share * (end - asked) for end in ends for share in _BLENDS]
            tried += [np.array(pair) for x, y in ends for pair in ((asked[0], y), (x, asked[1]))]
            closer = np.array(tried)
            closer = closer[self._slacks(closer).max(axis=1) >= 0.0]
            good = nearest_first(np.concatenate([good, closer]), asked)
        return [self._point.control(control, pair) for pair in good]


def _moves(obstacle: Any) -> bool:
    tracked, published = isinstance(obstacle, TrackedDiscs), isinstance(obstacle, Discs)
    return tracked or (published and obstacle.velocity_attribute is not None)


def _flat(values: Sequence[float]) -> tuple[float, float]:
    """X and y of what may have x alone."""
    return (values[0], values[1]) if len(values) > 1 else (values[0], 0.0)
