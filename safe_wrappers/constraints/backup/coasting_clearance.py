"""CoastingClearance: keep a machine that coasts to rest out of discs, by a rollout until it rests."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np

from safe_wrappers.constraints.detour import Detour
from safe_wrappers.constraints.obstacles import Disc, Discs, obstacles_from
from safe_wrappers.control.numerics.shapes import clearances_on_a_course, convex_outline, nearest_discs
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    check_fields,
    finite_array,
    non_negative,
    positive,
    whole_number,
)
from safe_wrappers.plants.mujoco.coasting import Coasting, Course
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Model, Plant, Trajectory

_SAME_M = 1e-6  # rounding of a rollout: a smaller loss of clearance is none
_WAY_OUT_M = 1e-3  # gain of clearance that is asked for where zero control leaves less than the margin
_RECOVERED = 0.5  # share of the best gain of clearance that a control has to reach from inside an obstacle
# Shares of the drive for the outer and the inner actuator of a detour, as they are tried.
_AROUND = ((1.0, 0.5), (1.0, 0.0), (1.0, -1.0), (-0.5, -1.0))


@dataclass
class CoastingClearance(Detour, Model):
    """Keep a free-moving machine out of discs, counting its whole way until it rests without control.

    For machines that friction and damping stop within a few steps, for example on wheels. A control is forecast on
    the machine's model: held for one control interval, then zero. It is admitted if the machine rests within
    `horizon` control intervals, and if on the whole way the body's origin stays out of `keep_out` and the outline out
    of `untouched`. From inside an obstacle controls are admitted that gain at least half of what full drive gains at
    best.

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
        detour: When a driving action of a machine with two actuators is refused, first try to turn while driving, or
            to reverse while turning, around the obstacle. No safety measure.
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
    recovery_s: ClassVar[float] = 0.0  # from inside an obstacle `leaves_clear` says what leads out
    detour_steps: ClassVar[int] = 25

    def __post_init__(self) -> None:
        for name in ("keep_out", "untouched"):
            found = obstacles_from(getattr(self, name), name, kinds=(Disc, Discs), optional=True)
            if any(getattr(obstacle, "velocity_attribute", None) is not None for obstacle in found):
                raise ConfigurationError(f"{name}: the way to rest is forecast past discs that stand still")
            setattr(self, name, found)
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
        self._origin = _Group(self.keep_out, np.zeros((0, 2)))
        self._whole = _Group(self.untouched, self._corners)
        self._most, self.max_decrease = self.max_decrease, None  # counted here, not by the filter
        self._first_turns_left: bool | None = None

    def clearance(self) -> Array:
        """On the way to rest without control, margin not taken off, m, shape (1,); minus infinity without rest.

        Where nothing is forecast, a lower bound: the present clearance less the way that the speed may add.
        """
        here = self.coasting.start()
        self._here, self._ahead = here.places[0], here.ahead[0]
        way, rolls = math.inf, 0.0
        if self._most is not None:
            added = self.max_decrease_per_speed * self.coasting.speed(self._radius)
            way = self._most + added
            rolls = added if self.max_decrease_per_speed else way
        room = self.margin + way
        self._least = min(group.keep(self.plant, here, room) for group in (self._origin, self._whole))
        self._within = way
        self._known: dict[bytes, _Outcome] = {}
        if self._origin.near or self._whole.near:
            return np.array([min(self._least, self._after(self._still).least)])
        return np.array([self._least - rolls])

    def nearest(self, neighbours: int) -> Array:
        discs = np.concatenate([self._origin.discs, self._whole.discs])
        (x, y), (ahead_x, ahead_y) = self._here, self._ahead
        vx, vy = self.coasting.velocity()
        return nearest_discs(discs, x, y, math.atan2(ahead_y, ahead_x), vx, vy, neighbours)

    def _after(self, control: Array) -> "_Outcome":
        """The outcome of a control, forecast once per observation."""
        low, high = self.plant.acting_range
        acting = np.minimum(np.maximum(control, low), high) + 0.0  # no -0.0: its bytes differ
        key = acting.tobytes()
        if key not in self._known:
            course = self.coasting.run(acting, self.horizon, self._radius)
            outcome, fallen = self._outcome(course)
            if fallen > self._within + _SAME_M:
                warnings.warn(
                    f"CoastingClearance: the clearance fell by {fallen:.3g} m until rest, farther than the declared "
                    f"max_decrease of {self._within:.3g} m; from now on every control is forecast",
                    stacklevel=2,
                )
                self._most = None
                self.memory["detour"] = 0.0, 0
                self.clearance()
                outcome, _ = self._outcome(course)
            self._known[key] = outcome
        return self._known[key]

    def _outcome(self, course: Course) -> tuple["_Outcome", float]:
        """What a course leads to, and by how much a clearance falls on it, m."""
        least, end, fallen = zip(*(group.along(course) for group in (self._origin, self._whole)), strict=True)
        (ax, ay), (bx, by) = course.ahead[0].tolist(), course.ahead[-1].tolist()
        way, turn = course.places[-1] - self._here, math.atan2(ax * by - ay * bx, ax * bx + ay * by)
        return _Outcome(min(least) if course.rests else -math.inf, min(end), way, turn), max(fallen)

    def leaves_clear(self, control: Array) -> bool:
        """Whether a control leads to rest with the margin kept (or, where rest alone does not, to a way out)."""
        if not (self._origin.near or self._whole.near):
            return True  # no disc can come into play, whatever is done
        if self._least < 0.0:
            return self._leads_out(control)
        after = self._after(control)
        if after.least >= self.margin:
            return True
        if after.least < 0.0:
            return False
        rest = self._after(self._still)
        if after is rest:
            return rest.least >= 0.0
        # The rollouts' errors have used up the margin: no less than rest leaves on the way, and more at its end.
        kept = after.least >= max(rest.least - _SAME_M, 0.0) and after.end >= rest.end + _WAY_OUT_M
        return rest.least < self.margin and kept

    def _leads_out(self, control: Array) -> bool:
        best = max(self._after(drive).end for drive in self._drives())
        gain = best - self._least
        return gain > 0.0 and self._after(control).end - self._least >= _RECOVERED * gain

    def _drives(self) -> list[Array]:
        """Full control of all actuators together and of each alone, both ways."""
        low, high = self.plant.acting_range
        return [high, low, *(np.where(one, end, 0.0) for one in np.eye(low.size) for end in (low, high))]

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        """The state now and the control: its course is forecast where `h_along` needs it, once per observation."""
        return Trajectory(control, self.plant.state[None])

    def h_along(self, path: Trajectory) -> Array:
        """The least clearance on the way, from inside an obstacle that at its end, m; infinite where none is near."""
        if path.control is None:
            return self.clearance()[None]
        admitted, least = self.leaves_clear(path.control), math.inf
        if self._origin.near or self._whole.near:
            after = self._after(path.control)
            least = after.end if self._least < 0.0 else after.least
        return np.array([[max(least, self.margin) if admitted else min(least, self.margin - _SAME_M)]])

    def points(self, path: Trajectory) -> Array:
        """The way of the origin until rest without control, m, shape (instants, 1, 2)."""
        course = self.coasting.run(self._still, self.horizon, self._radius)
        return np.concatenate([self._here[None], course.places])[:, None]

    def proposals(self, control: Array | None) -> list[Array]:
        """What to try for a refused control: ways around, less of the same, none. The backup is no control at all."""
        if control is None:
            return [self._still]
        if self._least < 0.0:
            return sorted(self._drives(), key=lambda u: -self._after(u).end)[:1]
        acting = np.clip(control, *self.plant.acting_range)
        around = self._around(acting) if self.detour and acting.size == 2 else []
        return [*around, 0.5 * acting, self._still]

    def _around(self, acting: Array) -> list[Array]:
        """The same drive turning ever more, then backing out while turning, all to the side that leads around."""
        drive = float(acting[np.abs(acting).argmax()])
        if float(acting.sum()) * drive <= 0.0:
            return []  # turning on the spot, or no drive at all

        def beside_the_nearest() -> float:
            way = self._after(acting).way
            group = min((g for g in (self._origin, self._whole) if g.near), key=lambda g: g.now.min())
            x, y = group.nearest() - self._here
            # What is to the left of the way is passed on its right.
            return -1.0 if way[0] * y - way[1] * x > 0.0 else 1.0

        side = self._kept_side() or beside_the_nearest()
        self._keep_side(side)
        if self._first_turns_left is None:
            first, second = (self._after(u).turn for u in (np.array([drive, 0.0]), np.array([0.0, drive])))
            self._first_turns_left = (first - second) * drive > 0.0
        pairs = np.array(_AROUND) * drive
        outer_is_first = self._first_turns_left == (side * drive > 0.0)
        return list(pairs if outer_is_first else pairs[:, ::-1])


class _Outcome(NamedTuple):
    """What a control leads to."""

    least: float  # the least clearance until rest, m; minus infinity without rest
    end: float  # the clearance at the end, m
    way: Array  # from here to there, shape (2,), m
    turn: float  # how far it turns on the way, rad


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

    def along(self, course: Course) -> tuple[float, float, float]:
        """Along a course: least clearance, that at its end, and the most that one of them fell, m."""
        if not self.near:
            return math.inf, math.inf, 0.0
        # Contiguous as at rest: for another layout the function is compiled once more.
        places = np.ascontiguousarray(course.places)
        left = clearances_on_a_course(self._outline, places, course.ahead, self._close)
        return float(left.min()), float(left[-1].min()), float((self.now - left.min(axis=0)).max())

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
