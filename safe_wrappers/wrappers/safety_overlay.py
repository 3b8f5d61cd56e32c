"""SafetyOverlay: draws into the env's frames what the filter knows and does."""

from collections import deque
from collections.abc import Iterable, Sequence
from itertools import combinations, pairwise, product
from typing import Any, ClassVar, Final

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.constraints.obstacles import Box, Plane, Round, TrackedDiscs
from safe_wrappers.constraints.points import Workspace
from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Step
from safe_wrappers.wrappers.stack import Layer
from safe_wrappers.wrappers.strip import STEPS, state_of, with_strip

Mark = dict[str, Any]
"""One shape, as `add_marker` of Gymnasium's viewers takes it."""

KEEP_OUT: Final = (0.95, 0.15, 0.1, 0.4)  # red, green, blue and opacity
LIMIT: Final = (0.95, 0.15, 0.1, 0.9)
WAY: Final = (1.0, 0.72, 0.05, 0.95)
ESTIMATE: Final = (0.55, 0.3, 0.8, 0.35)
MOST_MARKS: Final = 500
"""Of one frame. Gymnasium's scene has room for 1000 shapes, the model's own among them."""

_PIECES: Final = 30  # the most of one way
_THIN: Final = 0.012  # m: half the width of a line
_FLOOR: Final = 0.02  # m: the height at which what has no height is drawn, just above a floor at 0
_UP: Final = np.array([0.0, 0.0, 1.0])
_CIRCLE: Final = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0.0, 2.0 * np.pi, 17)])


class SafetyOverlay(LayerWrapper):
    """Draws what the filter inside knows and does into the env's own frames.

    In MuJoCo's scene, in frames and in the window: the obstacles of every constraint with what is kept free around
    them, and the way that its trajectory takes from here. Over the lower edge of a frame a strip: a column per step,
    in the colour of what was done to its action. Envs that are not MuJoCo's get the strip alone; so does an env
    without a filter.

    It only looks: actions, observations, rewards, infos and random numbers are bit for bit those without it.

    A window shows the marks of the state before the step, and in its corner what was done. Set no state by hand
    between `render` and `step`.

    Args:
        env: With a render mode "rgb_array" or "human".

    Raises:
        ConfigurationError: Another render mode or none; a window of an env that is not MuJoCo's.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = gym.make("SafePointGoal1-v0", render_mode="rgb_array")
        >>> env = sw.SafetyOverlay(sw.protect(env))  # gym.wrappers.RecordVideo goes around it
    """

    layer: ClassVar = Layer.OVERLAY

    def __init__(self, env: Env) -> None:
        LayerWrapper.__init__(self, env)
        modes = ["rgb_array"] if find_renderer(env) is None else ["rgb_array", "human"]
        if env.render_mode not in modes:
            raise ConfigurationError(
                f"SafetyOverlay draws into the frames of {name_of(env)}, whose render_mode is {env.render_mode!r}: "
                f"make the env with gym.make(..., render_mode={' or '.join(map(repr, modes))})"
            )
        self._inside = filter_inside(env)
        self._states: deque[str] = deque(maxlen=STEPS)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._states.clear()
        self._states.append(state_of(info))
        return observation

    def step(self, action: Any) -> Step:
        """Step the env; a window is drawn meanwhile."""
        if self.render_mode == "human":
            self._prepare()
        observation, reward, terminated, truncated, info = self._pass_on(action)
        self._states.append(state_of(info))
        return observation, reward, terminated, truncated, info

    def render(self) -> Any:
        """The env's frame with the overlay, of the same shape."""
        self._prepare()
        frame = self.env.render()
        return with_strip(frame, self._states) if isinstance(frame, np.ndarray) else frame

    def marks(self) -> list[Mark]:
        """What is drawn into the scene in the present state; nothing before a reset, or without a filter."""
        if not self._states or self._inside is None:
            return []
        return [one for bound in self._inside.look() for one in marks_of(bound.spec)]

    def _prepare(self) -> None:
        """Have the next frame show the present marks, and a window what was done."""
        renderer = find_renderer(self.env)
        if renderer is None:
            return
        viewer = renderer._get_viewer(str(self.render_mode))
        for one in self.marks()[:MOST_MARKS]:
            viewer.add_marker(**one)
        if self.render_mode == "human" and self._states:
            viewer.add_overlay(2, self._states[-1], "")  # mjGRID_BOTTOMLEFT


def find_renderer(env: Env) -> Any | None:
    """The `MujocoRenderer` of an env, or of the robot's env that it holds, as a maze does; None: it has none."""
    raw: Any = env.unwrapped
    held = [raw, *(inner for inner in vars(raw).values() if isinstance(inner, gym.Env))]
    return next(filter(None, (getattr(one, "mujoco_renderer", None) for one in held)), None)


def set_size(env: Env, width: int, height: int) -> None:
    """Have an env of which no frame has been asked yet draw frames of this size, px; others stay as they are."""
    renderer = find_renderer(env)
    if renderer is not None:
        renderer.width, renderer.height = width, height
        drawn = renderer.model.vis.global_
        drawn.offwidth, drawn.offheight = width, height


def marks_of(spec: Any) -> list[Mark]:
    """A constraint on its plant, now: its obstacles with what is kept free before them, its points and their way."""
    radius = getattr(spec, "radius", 0.0)
    inset = spec.margin + spec.state_error + radius
    way = _spatial(spec.points(spec.model.rollout(None))) if hasattr(spec, "points") else np.zeros((1, 0, 3))
    way = way[np.unique(np.linspace(0, len(way) - 1, _PIECES + 1, dtype=int))]
    found = [line for j in range(way.shape[1]) for line in _lines(WAY, way[:, j])]
    found += [mark("SPHERE", WAY, point, [max(radius, _THIN), 0.0, 0.0]) for point in way[-1]]
    obstacles = [one for name in ("obstacles", "keep_out", "untouched") for one in getattr(spec, name, ())]
    sides = [*(spec.low or [None]), *(spec.high or [None])] if isinstance(spec, Workspace) else [None]
    if None not in sides:
        corners = [*product(*np.transpose([np.array(spec.low) + inset, np.array(spec.high) - inset]))]
        edges = [ends for ends in combinations(np.array(corners), 2) if (ends[0] != ends[1]).sum() == 1]
        found += [line for ends in edges for line in _lines(LIMIT, ends, _THIN / 3.0)]
    here = way[0, 0] if way.shape[1] else np.zeros(3)
    return found + [one for obstacle in obstacles for one in _around(obstacle, spec.plant, inset, here)]


def _around(obstacle: Any, plant: Plant, inset: float, here: Array) -> list[Mark]:
    """An obstacle of the library's kinds, larger by an inset, m; of a plane the part nearest to a point."""
    if isinstance(obstacle, TrackedDiscs):
        centers, halves = (part[0] for part in obstacle.boxes(plant, np.zeros(1)))
        sizes = halves + obstacle.radius + inset
        return [mark("BOX", ESTIMATE, *box) for box in zip(_spatial(centers), _spatial(sizes), strict=True)]
    if isinstance(obstacle, Plane):
        normal = np.pad(obstacle.normal, (0, 3 - len(obstacle.normal)))
        foot = here - ((here - _spatial(obstacle.point)) @ normal - inset) * normal
        return [mark("BOX", KEEP_OUT, foot, [0.4, 0.4, 0.004], normal)]
    if isinstance(obstacle, Box):
        sides = _spatial(np.array(obstacle.half_size) + inset)
        return [mark("BOX", KEEP_OUT, _spatial(obstacle.center), sides)]
    if not isinstance(obstacle, Round):
        return []
    centers, radius = obstacle.centers(plant), obstacle.radius + inset
    if centers.shape[1] == 3:
        return [mark("SPHERE", KEEP_OUT, center, [radius, 0.0, 0.0]) for center in centers]
    return [line for center in _spatial(centers) for line in _lines(LIMIT, center + radius * _CIRCLE)]


def mark(shape: str, colour: Sequence[float], position: Array, size: ArrayLike, along: Array = _UP) -> Mark:
    """A shape about a point, its z axis along a vector, its size as for `mujoco.mjv_initGeom`."""
    turn, axes = np.zeros(4), np.zeros(9)
    mujoco.mju_quatZ2Vec(turn, along)
    mujoco.mju_quat2Mat(axes, turn)
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape}")
    return {"type": kind, "pos": position, "size": np.array(size), "mat": axes, "rgba": colour}


def _lines(colour: Sequence[float], points: Iterable[Array], width: float = _THIN) -> list[Mark]:
    """Thin boxes from each point to the next one, shape (3,), m: of many, round rods would cost most of a frame."""
    return [
        mark("BOX", colour, (a + b) / 2.0, [width, width, float(np.linalg.norm(b - a)) / 2.0], b - a)
        for a, b in pairwise(points)
    ]


def _spatial(points: ArrayLike) -> Array:
    """Points of one to three coordinates in space, shape (..., 3): what lacks a height lies on the floor."""
    given = np.asarray(points, dtype=np.float64)
    whole = np.full((*given.shape[:-1], 3), [0.0, 0.0, _FLOOR])
    whole[..., : given.shape[-1]] = given
    return whole
