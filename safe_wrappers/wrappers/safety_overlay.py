"""SafetyOverlay: draws into the env's frames what the filter knows and does."""

from collections import deque
from collections.abc import Iterable, Sequence
from itertools import chain, combinations, pairwise, product
from typing import Any, ClassVar, Final

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from safe_wrappers.constraints.obstacles import Box, Plane, Round, TrackedDiscs
from safe_wrappers.constraints.points import Workspace
from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Step
from safe_wrappers.wrappers.stack import Layer
from safe_wrappers.wrappers.strip import ACTIONS, STEPS, with_strip, words_of

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
_LENGTH, _THICKNESS = 4.0, 0.3  # of the longest arrow, in sizes of the body


class SafetyOverlay(LayerWrapper):
    """Draws what the filter inside knows and does into the env's own frames.

    In MuJoCo's scene, in frames and in the window: the obstacles of every constraint with what is kept free around
    them, and the way that its trajectory takes from here; the proposed action as an orange arrow and the executed one
    as a blue one, where it is known which way an action pushes. Over the lower edge of a frame a strip: what was done
    to the last action, margin, lease and slip as far as they are in info, a column per step as high as the margin,
    and the actions as bars. Envs that are not MuJoCo's get the strip alone; so does an env without a filter.

    It only looks: actions, observations, rewards, infos and random numbers are bit for bit those without it.

    A window shows the marks of the state before the step, and the strip's words in its corner. Set no state by hand
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
        self._infos: deque[dict[str, Any]] = deque(maxlen=STEPS)
        self._bounds: tuple[Array, Array] | None = None
        if isinstance(env.action_space, spaces.Box) and env.action_space.is_bounded():
            self._bounds = np.ravel(env.action_space.low), np.ravel(env.action_space.high)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._infos.clear()
        self._infos.append(dict(info))
        return observation

    def step(self, action: Any) -> Step:
        """Step the env; a window is drawn meanwhile."""
        if self.render_mode == "human":
            self._prepare()
        observation, reward, terminated, truncated, info = self._pass_on(action)
        self._infos.append(dict(info))
        return observation, reward, terminated, truncated, info

    def render(self) -> Any:
        """The env's frame with the overlay, of the same shape."""
        self._prepare()
        frame = self.env.render()
        return with_strip(frame, self._infos, self._bounds) if isinstance(frame, np.ndarray) else frame

    def marks(self) -> list[Mark]:
        """What is drawn into the scene in the present state; nothing before a reset, or without a filter."""
        if not self._infos or self._inside is None:
            return []
        specs = [bound.spec for bound in self._inside.look()]
        found = [one for spec in specs for one in marks_of(spec)]
        if specs and all(key in self._infos[-1] for key in ACTIONS):
            found += _arrows(self._inside.plant, specs, self._infos[-1])
        return found

    def _prepare(self) -> None:
        """Have the next frame show the present marks, and a window the strip's words."""
        renderer = find_renderer(self.env)
        if renderer is None:
            return
        viewer = renderer._get_viewer(str(self.render_mode))
        for one in self.marks()[:MOST_MARKS]:
            viewer.add_marker(**one)
        for word in words_of(self._infos[-1]) if self.render_mode == "human" and self._infos else ():
            viewer.add_overlay(2, word, "")  # mjGRID_BOTTOMLEFT


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
    if isinstance(spec, Workspace):
        low, high = spec.low or [None] * 3, spec.high or [None] * 3
        if None in (*low, *high):
            walls = zip([*low, *high], np.vstack([np.eye(3), -np.eye(3)]), strict=True)
            obstacles += [Plane(abs(normal) * v, normal) for v, normal in walls if v is not None]
        else:
            corners = [*product(*np.transpose([np.array(low) + inset, np.array(high) - inset]))]
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


def _arrows(plant: Plant, specs: Sequence[Any], info: dict[str, Any]) -> list[Mark]:
    """Two at a machine, the executed one above; none where it is not known which way an action pushes."""
    if isinstance(plant, DisplacementPlant):
        body, ways = plant.named("body", plant.gripper), np.eye(3, plant.lower.size)
        at, _ = plant.motion("body", plant.gripper)
    elif isinstance(plant, MujocoPlant) and plant.lower.size <= 2:  # an arrow shows no more numbers
        bodies = [(getattr(spec, "body", None), *getattr(spec, "bodies", ())) for spec in specs]
        named = [plant.named("body", name) for name in chain(*bodies) if name]
        moving = np.unique(plant.model.jnt_bodyid)
        if not named and len(moving) != 1:
            return []
        body = named[0] if named else int(moving[0])
        data, jacobian = plant.forward(), np.zeros((3, plant.model.nv))
        mujoco.mj_jacBodyCom(plant.model, data, jacobian, None, body)
        at, ways = data.xipos[body].copy(), jacobian @ plant.acceleration[1]  # 0 where it only turns
    else:
        return []
    # The longest push of a corner of the box has the full length; beyond `acting_range` nothing pushes harder.
    low, high = plant.acting_range
    reach = float(np.linalg.norm(np.abs(ways) @ np.maximum(np.abs(low), np.abs(high))))
    size = float(plant.model.geom_rbound[plant.model.geom_bodyid == body].max(initial=0.0))
    width, scale, found = _THICKNESS * size, _LENGTH * size / max(reach, 1e-9), []
    for height, (key, colour) in zip((1.0, 1.7), ACTIONS.items(), strict=True):
        vector = ways @ np.clip(info[key], low, high) * scale
        length = float(np.linalg.norm(vector))
        if length > width:  # a shorter one is all head
            rgba, tail = (*np.array(colour) / 255.0, 1.0), at + height * size * _UP
            # MuJoCo draws an arrow half as long as its size says.
            found.append(mark("ARROW", rgba, tail, [width, width, 2.0 * length], vector))
    return found


def mark(shape: str, colour: Sequence[float], position: Array, size: ArrayLike, along: Array = _UP) -> Mark:
    """A shape about a point (an arrow from it), its z axis along a vector, its size as for `mujoco.mjv_initGeom`."""
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
