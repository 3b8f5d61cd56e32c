"""EscapeClearance: for a point mass on two axes, out of the way of what moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from safe_wrappers.constraints.obstacles import (
    Disc,
    Discs,
    Plane,
    TrackedDiscs,
    distances,
    obstacles_from,
)
from safe_wrappers.control.backup.damped_axis import brake, step
from safe_wrappers.control.backup.evasive_maneuvers import Around, least_left, ways
from safe_wrappers.errors import Array, ConfigurationError, check_fields, non_negative, positive
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.plants.mujoco.planar_point import nearest_first, planar_point
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Model, Plant, Trajectory

_EVERY = 2  # holds between the instants at which ways are checked
_GOING_S = (0.3, 0.8)  # for how long the manoeuvres go before they brake, s
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
        holds = int(np.ceil(self.horizon_s / self.plant.control_dt))
        longest = max(1, round(max(_GOING_S) / self.plant.control_dt))
        if holds <= longest:
            raise ConfigurationError(
                f"horizon_s = {self.horizon_s:g} s is too short for steps of {self.plant.control_dt:g} s: a "
                f"manoeuvre takes {longest} of them before it brakes"
            )
        self._instants = np.arange(0, holds + 1, _EVERY)
        # Braking, then of each direction those that go for 1, 2, ... control steps.
        (x, y), zero = point.axes, 0.0
        forces = np.array([[x.high, zero], [x.low, zero], [zero, y.high], [zero, y.low]])
        self._controls = np.concatenate([[[zero, zero]], np.repeat(forces, longest, axis=0)])
        self._going = np.concatenate([[0], np.tile(np.arange(1, longest + 1), len(forces))])
        starts = 1 + longest * np.arange(len(forces))
        usual = [max(1, round(seconds / self.plant.control_dt)) for seconds in _GOING_S]
        self._usual = [0, *(int(start) + n - 1 for start in starts for n in usual)]

    def observe(self, memory: Memory) -> None:
        self._position, self._velocity = self._point.motion(self.plant)
        control = memory.get("control")
        # The manoeuvre that the executed control has left open goes on.
        self._going_on = None if control is None else memory["open"].get(control.tobytes())
        memory["open"] = {}

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        """The ways of all manoeuvres after a held control, shape (manoeuvres, instants, 2)."""
        if control is None:
            return Trajectory(None, self._position[None])
        axes, held = self._point.axes, self._driven(control)
        ends = [step(*at) for at in zip(axes, self._position, self._velocity, held, strict=True)]
        place, velocity = np.array(ends).T.copy()
        manoeuvres = self._controls[self._open], self._going[self._open]
        return Trajectory(control, ways(axes, place, velocity, *manoeuvres, self._instants))

    def clearance(self) -> Array:
        """Distance now, not along a manoeuvre, from every obstacle or the bound of where it may be, m, shape (n,)."""
        which, going_on = list(self._usual), self._going_on
        if going_on is not None:
            # The same way with one hold less to go: the manoeuvres of a direction are in the order of their lengths.
            shorter = going_on - 1 if self._going[going_on] > 1 else 0
            which += [i for i in (going_on, shorter) if i not in which]
        self._open = np.array(which, dtype=np.intp)
        # A way after a held control begins one hold from now.
        times = self.plant.control_dt * np.concatenate([[0.0], 1.0 + self._instants])
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

    def _driven(self, control: Array) -> Array:
        return np.asarray(control)[self._point.actuators]

    def h_along(self, path: Trajectory) -> Array:
        """What the best way out after a held control leaves, m; now the distance from what is around."""
        if path.control is None:
            return self.clearance()[None]
        left = self._left(path)
        return np.array([[left + self.margin - (self._needed() if left < 0.0 else 0.0)]])

    def _left(self, path: Trajectory) -> float:
        """What the best way out leaves of what is wanted, m; which one it is is remembered."""
        left, control = least_left(path.states, self._around, self._wanted), path.control
        best = int(left.argmax())
        assert control is not None
        self.memory["open"][control.tobytes()] = int(self._open[best])
        return float(left[best])

    def _needed(self) -> float:
        """What a way out must leave: 0, or the best that there is while new estimates use up only the margin."""
        if self._best is None:
            self._best = max(left for _, left in self._firsts())
        return self._best if -self.margin < self._best < 0.0 else 0.0

    def _firsts(self) -> list[tuple[Array, float]]:
        """First controls of the manoeuvres, braking and each direction; and what each leaves, m."""
        axes = self._point.axes
        braking = [brake(axis, v) for axis, v in zip(axes, self._velocity, strict=True)]
        pairs = [braking, *self._controls[self._going == 1]]
        controls = [self._point.control(np.zeros(self.plant.lower.size), pair) for pair in pairs]
        return [(control, self._left(self.rollout(control))) for control in controls]

    def proposals(self, control: Array | None) -> list[Array]:
        """Controls near a refused one, the nearest first; of None: braking, or what keeps farthest away."""
        firsts = self._firsts()
        self._best = max(left for _, left in firsts)
        if control is None:
            return [firsts[0][0] if firsts[0][1] >= 0.0 else max(firsts, key=lambda one: one[1])[0]]
        asked, needed = self._driven(control), self._needed()
        good = [self._driven(first) for first, left in firsts if left >= needed]
        good = list(nearest_first(np.array(good).reshape(-1, 2), asked))
        if needed == 0.0:
            for x, y in good[:_APPROACHED]:
                good += [asked + share * (np.array([x, y]) - asked) for share in _BLENDS]
                good += [np.array(pair) for pair in ((asked[0], y), (x, asked[1]))]
        pairs = nearest_first(np.array(good).reshape(-1, 2), asked)
        return [self._point.control(control, pair) for pair in pairs]


def _moves(obstacle: Any) -> bool:
    tracked, published = isinstance(obstacle, TrackedDiscs), isinstance(obstacle, Discs)
    return tracked or (published and obstacle.velocity_attribute is not None)


def _flat(values: Sequence[float]) -> tuple[float, float]:
    """X and y of what may have x alone."""
    return (values[0], values[1]) if len(values) > 1 else (values[0], 0.0)
