"""Frames of episodes become a small animated WebP; a strip below each shows when the filter acted."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from safe_wrappers import info as keys
from safe_wrappers.drawing.scene import find_renderer, set_size
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.safety_overlay import SafetyOverlay

from ..evaluation.step_log import is_violation
from ..run.policy import TrainedPolicy

WIDTH: Final = 480
HEIGHT: Final = 360
"""Pixels of an episode's picture, whose width an env that MuJoCo does not draw may decide."""
STRIP: Final = 16
"""Below it, px."""
TITLE: Final = 24
"""Above it, px."""
MOST_FRAMES: Final = 100
MOST_BYTES: Final = 2_000_000
_LONGEST_S: Final = 10.0
_SHORTEST_S: Final = 4.0
_QUALITY: Final = 55
_GAP: Final = 8  # px between two episodes
_WIDE: Final = 3  # px: half of what marks one step in the strip
_COLORS: Final = {
    "bare": (120, 128, 138),
    "changed": (240, 178, 20),
    "violated": (214, 40, 52),
    "now": (255, 255, 255),
    "title": (29, 35, 43),
}


def for_film(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """An env of which no frame was asked yet, as films show it: the robot in sight, and what its filter does."""
    set_size(env, WIDTH, HEIGHT)
    return InSight(env if filter_inside(env) is None else SafetyOverlay(env))


class InSight(gym.Wrapper[Any, Any, Any, Any]):
    """Frames in whose middle the robot stays: the free camera follows it.

    Fixed cameras stay where they are, and so does the picture of an env that MuJoCo does not draw.

    Args:
        env: Makes frames (render mode "rgb_array").
    """

    def render(self) -> Any:
        """The env's frame."""
        renderer = find_renderer(self.env)
        if renderer is not None and renderer.camera_id in (None, -1):
            viewer = renderer._get_viewer(str(self.render_mode))
            # Half of what a frame costs without a graphics card.
            viewer.scn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            root = robot_root(renderer.model)
            if root is not None:
                viewer.cam.type, viewer.cam.trackbodyid = int(mujoco.mjtCamera.mjCAMERA_TRACKING), root
        return self.env.render()


def robot_root(model: mujoco.MjModel) -> int | None:
    """The root body of what the first actuator moves; None where it moves no joint, site or body."""
    kinds = mujoco.mjtTrn
    for kind, at in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True):
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            return int(model.body_rootid[model.jnt_bodyid[at]])
        if kind == kinds.mjTRN_SITE:
            return int(model.body_rootid[model.site_bodyid[at]])
        if kind == kinds.mjTRN_BODY:
            return int(model.body_rootid[at])
    return None


@dataclass
class Film:
    """An episode's frames, every `stride` steps, and what happened at each step."""

    stride: int
    frames: list[Image.Image] = field(default_factory=list)
    changed: list[bool] = field(default_factory=list)
    violated: list[bool] = field(default_factory=list)
    title: str = ""

    @property
    def wants_frame(self) -> bool:
        """Whether the coming step's frame will be shown."""
        return len(self.changed) % self.stride == 0

    def add_frame(self, pixels: NDArray[np.uint8]) -> None:
        """Takes the frame before the coming step, shape (height, width, 3).

        Every other frame goes where the episode is longer than thought.
        """
        if len(self.frames) == MOST_FRAMES:
            self.frames, self.stride = self.frames[::2], 2 * self.stride
        if self.wants_frame:
            picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3], dtype=np.uint8))
            width = round(picture.width * HEIGHT / picture.height)
            self.frames.append(picture.resize((width, HEIGHT), Image.Resampling.LANCZOS))


def film_episodes(
    policy: TrainedPolicy, env: gym.Env[Any, Any], seeds: Mapping[str, int]
) -> tuple[bytes, float, list[Film]]:
    """Runs episodes and films them side by side.

    Args:
        policy: Acts, deterministically.
        env: As `for_film` returns it, with a `RecordInterventions` inside.
        seeds: Of the env's resets, by title.

    Returns:
        The animated WebP, times real time at which it shows them, and each episode.
    """
    longest = (env.spec.max_episode_steps if env.spec is not None else None) or 1
    stride = -(-longest // MOST_FRAMES)
    films = [_film_episode(policy, env, title, seed, stride) for title, seed in seeds.items()]
    fps = float(env.metadata.get("render_fps") or 30.0)
    # One speed for all conditions, also where one of them ends early; it takes 4 to 10 seconds.
    real_s = max(longest, *(len(film.changed) for film in films)) / fps
    speed = real_s / min(max(real_s, _SHORTEST_S), _LONGEST_S)
    return encode(films, fps * speed), speed, films


def _film_episode(policy: TrainedPolicy, env: gym.Env[Any, Any], title: str, seed: int, stride: int) -> Film:
    film = Film(stride)
    observation, _ = env.reset(seed=seed)
    policy.begin(env)
    done = False
    while not done:
        if film.wants_frame:
            film.add_frame(env.render())  # type: ignore[arg-type]
        observation, _, terminated, truncated, info = env.step(policy(observation))
        film.changed.append(bool(info.get(keys.CBF_INTERVENED, False)))
        film.violated.append(is_violation(info))
        done = terminated or truncated
    figures = info[keys.EPISODE_SUMMARY]
    hurt = f", {figures['violations']:,} in violation" if "violations" in figures else ""
    film.title = f"{title}: episode {seed}, return {figures['return']:.1f}{hurt}"
    return film


def encode(films: Sequence[Film], steps_per_s: float) -> bytes:
    """An endless animated WebP of at most `MOST_BYTES`; half of the frames go until it fits.

    Args:
        films: Shown side by side, each with at least one frame; where one ends early, its last frame stays.
        steps_per_s: Control steps that are shown per second.
    """
    stride = max(film.stride for film in films)
    steps = max(len(film.changed) for film in films)
    while True:
        pictures = [_side_by_side([_picture(film, at) for film in films]) for at in range(0, steps, stride)]
        data = io.BytesIO()
        duration = max(1, round(1000 * stride / steps_per_s))
        pictures[0].save(
            data, "WEBP", save_all=True, append_images=pictures[1:], duration=duration, loop=0, quality=_QUALITY
        )  # fmt: skip
        if data.tell() <= MOST_BYTES or len(pictures) == 1:
            return data.getvalue()
        stride *= 2


def _side_by_side(parts: Sequence[Image.Image]) -> Image.Image:
    width = sum(part.width for part in parts) + _GAP * (len(parts) - 1)
    whole = Image.new("RGB", (width, parts[0].height), _COLORS["now"])
    left = 0
    for part in parts:
        whole.paste(part, (left, 0))
        left += part.width + _GAP
    return whole


def _picture(film: Film, step: int) -> Image.Image:
    """A frame with the title above and the strip below."""
    at = min(step // film.stride, len(film.frames) - 1)
    picture = film.frames[at]
    steps = len(film.changed)
    columns = np.arange(picture.width) * steps // picture.width
    row = np.tile(np.array(_COLORS["bare"], dtype=np.uint8), (picture.width, 1))
    # One step that hurt must not be lost between two columns, nor in the coding: it is several columns wide.
    for flags, color in ((film.changed, "changed"), (film.violated, "violated")):
        hits = np.flatnonzero(flags)[:, None] * picture.width // steps + np.arange(-_WIDE, _WIDE + 1)
        row[np.clip(hits, 0, picture.width - 1)] = _COLORS[color]
        row[np.asarray(flags, dtype=bool)[columns]] = _COLORS[color]
    now = min(picture.width - 1, at * film.stride * picture.width // steps)
    row[max(0, now - _WIDE) : now + _WIDE + 1] = _COLORS["now"]
    whole = Image.new("RGB", (picture.width, TITLE + picture.height + STRIP), _COLORS["now"])
    ImageDraw.Draw(whole).text((4, 3), film.title, _COLORS["title"], ImageFont.load_default(size=15))
    whole.paste(picture, (0, TITLE))
    whole.paste(Image.fromarray(np.tile(row[None], (STRIP, 1, 1))), (0, TITLE + picture.height))
    return whole
