"""SafetyOverlay: draws into the env's frames what the filter knows and does."""

from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces

from safe_wrappers import info as keys
from safe_wrappers.checks import Array
from safe_wrappers.constraints.obstacles import Box, Disc, Discs, Plane, Sphere, TrackedDiscs
from safe_wrappers.constraints.points import Workspace
from safe_wrappers.drawing.marks import THIN, Mark, ball, block, edges, line, pad, ring, spatial
from safe_wrappers.drawing.scene import Strip, arrows, find_renderer, put
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.plants.plant import Plant
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Reset, Step

_MODES: Final = ("rgb_array", "human")
_PAD_M: Final = 0.4  # half of the square that is drawn of a plane
_LISTS: Final = ("obstacles", "keep_out", "untouched")


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
        if env.render_mode not in _MODES:
            raise ConfigurationError(
                f"SafetyOverlay draws into the frames of {name_of(env)}, whose render_mode is {env.render_mode!r}: "
                "make the env with gym.make(..., render_mode='rgb_array'), or 'human' for a window"
            )
        if env.render_mode == "human" and find_renderer(env) is None:
            raise ConfigurationError(
                f"SafetyOverlay draws into the windows of MuJoCo envs alone, which {name_of(env)} is not: take "
                "render_mode='rgb_array', whose frames get a strip"
            )
        self._record({})
        self._inside = filter_inside(env)
        self._strip = Strip()
        if isinstance(env.action_space, spaces.Box) and env.action_space.is_bounded():
            self._strip = Strip(np.ravel(env.action_space.low), np.ravel(env.action_space.high))
        self._last: dict[str, Any] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env; the strip begins anew."""
        self._last = None
        observation, info = self.env.reset(seed=seed, options=options)
        self._last = dict(info)
        self._strip.begin(info)
        return observation, info

    def step(self, action: Any) -> Step:
        """Step the env; a window is drawn meanwhile."""
        if self.render_mode == "human":
            self._prepare()
        observation, reward, terminated, truncated, info = self._pass_on(action)
        self._last = dict(info)
        self._strip.add(info)
        return observation, reward, terminated, truncated, info

    def render(self) -> Any:
        """The env's frame with the overlay, of the same shape."""
        self._prepare()
        frame = self.env.render()
        return self._strip.on(frame) if isinstance(frame, np.ndarray) else frame

    def marks(self) -> list[Mark]:
        """What is drawn into the scene in the present state; nothing before a reset, or without a filter."""
        if self._last is None or self._inside is None:
            return []
        bound = self._inside.look()
        found = [mark for constraint in bound for mark in marks_of(constraint.spec)]
        proposed, executed = (self._last.get(key) for key in (keys.PROPOSED_ACTION, keys.EXECUTED_ACTION))
        if bound and proposed is not None and executed is not None:
            specs = [constraint.spec for constraint in bound]
            found += arrows(self._inside.plant, specs, proposed, executed)
        return found

    def _prepare(self) -> None:
        """Have the next frame show the present marks, and a window the strip's words."""
        renderer = find_renderer(self.env)
        if renderer is None:
            return
        put(self.marks(), renderer, str(self.render_mode))
        if self.render_mode == "human":
            viewer = renderer._get_viewer("human")
            for word in self._strip.words:
                viewer.add_overlay(2, word, "")  # mjGRID_BOTTOMLEFT


def marks_of(spec: Any) -> list[Mark]:
    """A constraint in the present state: its obstacles with what is kept free before them, its points, their way.

    Args:
        spec: On its plant. Where it has `points`, they are drawn along the trajectory from the present state.
    """
    inset = spec.margin + spec.state_error + getattr(spec, "radius", 0.0)
    way = np.zeros((1, 0, 3)) if not hasattr(spec, "points") else spec.points(spec.model.rollout(None))
    found = [mark for j in range(way.shape[1]) for mark in line("way", way[:, j], THIN)]
    found += [ball("way", point, max(getattr(spec, "radius", 0.0), THIN)) for point in way[-1]]
    at = way[0, 0] if way.shape[1] else np.zeros(3)
    obstacles = [obstacle for name in _LISTS for obstacle in getattr(spec, name, ())]
    if isinstance(spec, Workspace):
        low, high = spec.low or [None] * 3, spec.high or [None] * 3
        if None in (*low, *high):
            units = np.eye(3)
            obstacles += [Plane(units[i] * v, units[i]) for i, v in enumerate(low) if v is not None]
            obstacles += [Plane(units[i] * v, -units[i]) for i, v in enumerate(high) if v is not None]
        else:
            found += edges("limit", np.array(low) + inset, np.array(high) - inset, THIN / 3.0)
    return found + [mark for obstacle in obstacles for mark in _marks(obstacle, spec.plant, inset, at)]


def _marks(obstacle: Any, plant: Plant, inset: float, point: Array) -> list[Mark]:
    """An obstacle of the library's kinds, larger by an inset, m; of a plane the part nearest to a point."""
    if isinstance(obstacle, Disc | Discs | Sphere):
        centers, radius = obstacle.centers(plant), obstacle.radius + inset
        if centers.shape[1] == 2:
            return [mark for center in centers for mark in ring("limit", center, radius)]
        return [ball("keep out", center, radius) for center in centers]
    if isinstance(obstacle, Box):
        return [block("keep out", obstacle.center, np.array(obstacle.half_size) + inset)]
    if isinstance(obstacle, Plane):
        normal = spatial(obstacle.normal, 0.0)
        at, of = spatial(point), spatial(obstacle.point, 0.0)
        foot = at - ((at - of) @ normal - inset) * normal
        return [pad("keep out", foot, normal, _PAD_M)]
    if isinstance(obstacle, TrackedDiscs):
        centers, halves = (part[0] for part in obstacle.boxes(plant, np.zeros(1)))
        sizes = halves + obstacle.radius + inset
        return [block("estimate", *one) for one in zip(centers, sizes, strict=True)]
    return []
