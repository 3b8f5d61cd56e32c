"""CoastingClearance: keep a machine that coasts to rest out of discs, by a rollout until it rests."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from safe_wrappers.constraints.detour import Detour
from safe_wrappers.control.shapes import clearances_on_a_course, convex_outline, nearest_discs
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    check_fields,
    finite_array,
    non_negative,
    positive,
    whole_number,
)
from safe_wrappers.filter.constraint import Memory
from safe_wrappers.plants.mujoco.coasting import Coasting, Course
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Model, Plant, Trajectory

_SAME_M = 1e-6  # rounding of a rollout: a smaller loss of clearance is none
# Shares of the drive for the outer and the inner actuator of a detour, as they are tried. The last two turn the other
# way, for a machine that is wedged between obstacles.
_AROUND = ((1.0, 0.5), (1.0, 0.0), (1.0, -1.0), (-0.5, -1.0), (-1.0, -0.5), (-1.0, 1.0))


@dataclass
class CoastingClearance(Detour, Model):
    """Keep a free-moving machine out of discs, counting its whole way until it rests without control.

    For machines that friction and damping stop within a few steps, for example on wheels. A control is forecast on
    the machine's model: held for one control interval, then zero. It is admitted if the machine rests within
    `horizon` control intervals, and if on the whole way the body's origin stays out of `keep_out` and the outline out
    of `untouched`. The backup is no control; where that is not clear any more, the full drive that ends farthest out.

    Proved, for obstacles that stand still, and as far as `margin` covers the forecast's error: from a state whose way
    to rest is clear (h >= 0) there is always an admissible control, and every physics substep is clear.

    Args:
        keep_out: `Disc` and `Discs` for the body's origin.
        untouched: `Disc` and `Discs` for the outline.
        outline: Points [x, y] in the body's frame, m; the outline is their convex hull. Needed for `untouched`; with
            `keep_out` alone only `max_decrease_per_speed` counts its corners.
        body: Name of the machine's body, on a free joint.
        robot_model_attr: Name of an attribute of the env that holds a model of the machine alone, for the forecasts;
            None takes the plant's model.
        margin: Kept free, m: covers the forecast's error and the tilt of the outline.
        horizon: Control intervals within which the machine has to rest.
        max_decrease: Bound on the way of the origin or a corner of the outline until rest, m, for any control held
            for one interval from rest; states with more clearance need no forecast. Checked at every forecast, and
            dropped with a warning when broken.
        max_decrease_per_speed: What the speed of the origin or a corner adds to that, m per m/s.
        detour: When an action of a machine with two driven wheels is refused, first try to turn while driving, or to
            reverse while turning, around the obstacle; or, in place of a turn on the spot, to make room for it. No
            safety measure.
    """

    keep_out: Sequence[Any] = ()
    untouched: Sequence[Any] = ()
    outline: Sequence[Sequence[float]] = ()
    body: str = "agent"
    robot_model_attr: str | None = None
    margin: float = 0.005
    horizon: int = 12
    max_decrease: float | None = None
    max_decrease_per_speed: float = 0.0
    detour: bool = False

    promise = "proved"
    smooth: ClassVar[bool] = False
    detour_steps: ClassVar[int] = 25

    def __post_init__(self) -> None:
        self._check_shared("keep_out", "untouched")
        if not (self.keep_out or self.untouched):
            raise ConfigurationError("give obstacles in keep_out (for the origin) or untouched (the outline)")
        self.outline = _checked_outline(self.outline)
        if self.untouched and not self.outline:
            raise ConfigurationError(
                "untouched needs the machine's outline: [[x, y], ...] in its body's frame"
            )
        if self.outline and not self.untouched and self.max_decrease is None:
            raise ConfigurationError(
                "outline is kept out of untouched, and keep_out is for the body's origin alone: give the obstacles "
                "that the outline must not meet in untouched, or leave outline out"
            )
        self.horizon = whole_number("horizon", self.horizon, 2, "control intervals")
        check_fields(self, non_negative, ("margin",), "m")
        check_fields(self, positive, ("max_decrease",), "m")
        check_fields(self, non_negative, ("max_decrease_per_speed",), "m per m/s")

    def setup(self, plant: Plant) -> None:
        hint = "CoastingClearance needs a MujocoPlant: it forecasts with the machine's model"
        super().setup(require_mujoco(plant, hint))
        name = self.robot_model_attr
        alone = None if name is None else plant.attribute(name)
        if alone is not None and not isinstance(alone, mujoco.MjModel):
            wanted = "robot_model_attr names an attribute that holds an MjModel"
            raise ConfigurationError(f"{wanted}; {name!r} is {alone!r}")
        self.plant.named("body", self.body, "body")
        self.coasting = Coasting(self.plant, self.body, alone)
        self._still = np.zeros(self.plant.model.nu)
        outline = np.reshape(self.outline, (-1, 2))
        self._corners = convex_outline(outline) if len(outline) else outline
        self._radius = float(np.sqrt((self._corners**2).sum(axis=1)).max(initial=0.0))
        self._groups = _Group(self.keep_out, np.zeros((0, 2))), _Group(self.untouched, self._corners)
        self._most, self.max_decrease = self.max_decrease, None  # counted here, not by the filter
        self._first_turns_left: bool | None = None

    def observe(self, memory: Memory) -> None:
        super().observe(memory)
        self._look()

    def _look(self) -> None:
        """See which discs may come into play, whatever is done."""
        here = self.coasting.start()
        self._here, self._ahead = here.places[0], here.ahead[0]
        self._within, self._rolls = math.inf, 0.0
        if self._most is not None:
            added = self.max_decrease_per_speed * self.coasting.speed(self._radius)
            self._within = self._most + added
            self._rolls = added if self.max_decrease_per_speed else self._within
        room = self.margin + self._within
        self._least = min(group.keep(self.plant, here, room) for group in self._groups)
        self._near = any(group.near for group in self._groups)
        self._known: dict[bytes, Course] = {}

    def nearest(self, neighbours: int) -> Array:
        discs = np.concatenate([group.discs for group in self._groups])
        (x, y), (ahead_x, ahead_y) = self._here, self._ahead
        vx, vy = self.coasting.velocity()
        return nearest_discs(discs, x, y, math.atan2(ahead_y, ahead_x), vx, vy, neighbours)

    def rollout(self, control: Array | None, horizon: int = 1) -> "Way":
        """A control held for one control interval, then none until rest; of None the way to rest from here.

        Each course is forecast once per observation, and only where a disc may come into play.
        """
        return Way(control, self._course(self._still if control is None else control) if self._near else None)

    def _course(self, control: Array) -> Course:
        low, high = self.plant.acting_range
        acting = np.minimum(np.maximum(control, low), high) + 0.0  # no -0.0: its bytes differ
        key = acting.tobytes()
        if key not in self._known:
            course = self.coasting.run(acting, self.horizon, self._radius)
            fallen = max(group.fallen(course) for group in self._groups)
            if fallen > self._within + _SAME_M:
                warnings.warn(
                    f"CoastingClearance: the clearance fell by {fallen:.3g} m until rest, farther than the declared "
                    f"max_decrease of {self._within:.3g} m; from now on every control is forecast",
                    stacklevel=2,
                )
                self._most = None
                self._look()
            self._known[key] = course
        return self._known[key]

    def h_along(self, path: "Way") -> Array:
        """Clearance of the nearest disc that may come into play, m, shape (instants, 1); minus infinity without rest.

        Where none may, that of the nearest one now, less the way that the speed may add.
        """
        if path.course is None:
            return np.array([[self._least - self._rolls]]) if path.control is None else np.zeros((1, 0))
        every = np.concatenate([group.along(path.course) for group in self._groups], axis=1)
        # One number: a `max_decrease` that proves wrong brings more discs into play in the middle of a step.
        left = every.min(axis=1, keepdims=True)
        if path.control is None:
            left = np.vstack([[[self._least]], left])
        return left if path.course.rests else np.full_like(left, -np.inf)

    def _end(self, control: Array) -> float:
        """The least clearance at the end, m."""
        return float(self.h_along(self.rollout(control))[-1].min(initial=np.inf))

    def points(self, path: Trajectory) -> Array:
        """The way of the origin until rest without control, m, shape (instants, 1, 2)."""
        course = self.coasting.run(self._still, self.horizon, self._radius)
        return np.concatenate([self._here[None], course.places])[:, None]

    def proposals(self, control: Array | None) -> list[Array]:
        """What to try for a refused control: ways around, half of it and of them, none.

        The backup is no control at all; where that is not clear, what ends farthest out: full control of all
        actuators together or of one, either way.
        """
        if control is None:
            if self._near and self.h_along(self.rollout(None)).min() < 0.0:
                low, high = self.plant.acting_range
                ones = [np.where(one, end, 0.0) for one in np.eye(low.size) for end in (low, high)]
                return sorted([self._still, high, low, *ones], key=lambda u: -self._end(u))[:1]
            return [self._still]
        acting = np.clip(control, *self.plant.acting_range)
        around = self._around(acting) if self.detour and acting.size == 2 else []
        # A machine that is wedged leaves in smaller steps than it came in.
        return [*around, *(0.5 * one for one in (acting, *around)), self._still]

    def _around(self, acting: Array) -> list[Array]:
        """The drive turning ever more, then backing out while turning, to the side that leads around; then away.

        In place of turning on the spot: one wheel of it, then straight on or back; first what ends farther out.
        """
        drive = float(acting[np.abs(acting).argmax()])
        if float(acting.sum()) * drive <= 0.0:
            wheels, straight = list(np.diag(acting)), [np.full(2, drive), np.full(2, -drive)]
            return [one for pair in (wheels, straight) for one in sorted(pair, key=lambda u: -self._end(u))]

        def beside_the_nearest() -> float:
            way = self._course(acting).places[-1] - self._here
            group = min((g for g in self._groups if g.near), key=lambda g: g.now.min())
            x, y = group.nearest() - self._here
            # What is to the left of the way is passed on its right.
            return -1.0 if way[0] * y - way[1] * x > 0.0 else 1.0

        side = self._kept_side() or beside_the_nearest()
        self._keep_side(side)
        if self._first_turns_left is None:
            first, second = (_turn(self._course(drive * one)) for one in np.eye(2))
            self._first_turns_left = (first - second) * drive > 0.0
        pairs = np.array(_AROUND) * drive
        outer_is_first = self._first_turns_left == (side * drive > 0.0)
        return list(pairs if outer_is_first else pairs[:, ::-1])


class Way(Trajectory):
    """A course to rest; None: no disc may come into play on it."""

    def __init__(self, control: Array | None, course: Course | None) -> None:
        super().__init__(control, np.empty((0, 2)) if course is None else course.places)
        self.course = course


def _turn(course: Course) -> float:
    """How far the body turns on its way, rad."""
    (ax, ay), (bx, by) = course.ahead[0].tolist(), course.ahead[-1].tolist()
    return math.atan2(ax * by - ay * bx, ax * bx + ay * by)


class _Group:
    """Discs that the outline, corners (c, 2) in the body's frame, keeps clear of; without corners the origin does.

    Attributes:
        discs: Centres and radii of all, m, shape (n, 3).
        near: Whether one of them may come into play.
        now: What is left to those that may, shape (close ones,), m.
    """

    def __init__(self, obstacles: Sequence[Any], outline: Array) -> None:
        self._obstacles, self._outline = obstacles, outline
        self.discs = np.zeros((0, 3))

    def keep(self, plant: MujocoPlant, here: Course, room: float) -> float:
        """Take the discs that are closer than `room`, m; the least clearance of all, m."""
        where = [o.centers(plant)[:, :2] for o in self._obstacles]
        if sum(map(len, where)) != len(self.discs):
            radii = np.repeat([o.radius for o in self._obstacles], [len(w) for w in where])
            self.discs = np.zeros((len(radii), 3))
            self.discs[:, 2] = radii
        if where:
            np.concatenate(where, out=self.discs[:, :2])
        now = clearances_on_a_course(self._outline, *here[:2], self.discs)[0]
        close = now < room
        self.near = bool(close.any())
        self._close, self.now = self.discs[close], now[close]
        return float(now.min(initial=np.inf))

    def along(self, course: Course) -> Array:
        """What is left to the close discs along a course, m, shape (instants, close ones)."""
        # Contiguous as at rest: for another layout the function is compiled once more.
        places = np.ascontiguousarray(course.places)
        return clearances_on_a_course(self._outline, places, course.ahead, self._close)

    def fallen(self, course: Course) -> float:
        """The most that the clearance of one of them falls on a course, m."""
        return float((self.now - self.along(course).min(axis=0)).max(initial=0.0))

    def nearest(self) -> Array:
        """Centre of the disc with the least room, shape (2,), m."""
        return np.asarray(self._close[self.now.argmin(), :2])


def _checked_outline(given: Any) -> list[list[float]]:
    points = finite_array("outline", given)
    if points.size and (points.ndim != 2 or points.shape[1] != 2):
        raise ConfigurationError(f"outline is a list of points [x, y] in m, got {given!r}")
    if points.size:
        convex_outline(points)  # refuses points on one line
    found: list[list[float]] = points.tolist()
    return found
