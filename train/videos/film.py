"""Frames of episodes become a small animated WebP; a strip below each shows when the filter acted."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from safe_wrappers import info as keys
from safe_wrappers.drawing.scene import set_size
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.safety_overlay import SafetyOverlay

from ..evaluation.step_log import is_violation
from ..run.policy import TrainedPolicy
from .sight import InSight

WIDTH: Final = 480
HEIGHT: Final = 360
"""Pixels of an episode's picture, whose width an env that MuJoCo does not draw may decide."""
STRIP: Final = 16
"""Below it, px."""
TITLE: Final = 24
"""Above it, px; a film without a title has none."""
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


@dataclass
class Film:
    """Collects frames and what happened at each step; thins itself out where the episode is longer than thought.

    Ask `wants_frame` before each step and give it one if so; tell it of every step.
    """

    frames: list[Image.Image] = field(default_factory=list)
    stride: int = 1
    changed: list[bool] = field(default_factory=list)
    violated: list[bool] = field(default_factory=list)
    title: str = ""
    figures: dict[str, Any] = field(default_factory=dict)
    """The episode's, as `RecordInterventions` has them."""

    @property
    def wants_frame(self) -> bool:
        """Whether the coming step's frame will be shown."""
        return len(self.changed) % self.stride == 0

    def add_frame(self, pixels: NDArray[np.uint8]) -> None:
        """Takes the frame before the coming step, shape (height, width, 3)."""
        if len(self.frames) == MOST_FRAMES:
            self.frames = self.frames[::2]
            self.stride *= 2
            if not self.wants_frame:
                return
        picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3], dtype=np.uint8))
        width = round(picture.width * HEIGHT / picture.height)
        self.frames.append(picture.resize((width, HEIGHT), Image.Resampling.LANCZOS))

    def add_step(self, changed: bool, violated: bool) -> None:
        """Takes what the step did."""
        self.changed.append(changed)
        self.violated.append(violated)


def stride_of(steps: int) -> int:
    """Every which step is filmed, so that an episode of that many needs no thinning."""
    return -(-steps // MOST_FRAMES)


def speed_of(steps: int, fps: float) -> float:
    """Times real time at which an episode is shown, so that it takes 4 to 10 seconds.

    Args:
        steps: Of the longest episode.
        fps: Control steps per second of the task.
    """
    real_s = steps / fps
    return real_s / min(max(real_s, _SHORTEST_S), _LONGEST_S)


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
    films = [_film_episode(policy, env, title, seed, stride_of(longest)) for title, seed in seeds.items()]
    fps = float(env.metadata.get("render_fps") or 30.0)
    # One speed for all conditions, also where one of them ends early.
    speed = speed_of(max(longest, *(len(film.changed) for film in films)), fps)
    return encode(films, fps, speed), speed, films


def _film_episode(policy: TrainedPolicy, env: gym.Env[Any, Any], title: str, seed: int, stride: int) -> Film:
    film = Film(stride=stride)
    observation, _ = env.reset(seed=seed)
    policy.begin(env)
    done = False
    while not done:
        if film.wants_frame:
            film.add_frame(env.render())  # type: ignore[arg-type]
        observation, _, terminated, truncated, info = env.step(policy(observation))
        film.add_step(bool(info.get(keys.CBF_INTERVENED, False)), is_violation(info))
        done = terminated or truncated
    film.figures = info[keys.EPISODE_SUMMARY]
    hurt = f", {film.figures['violations']:,} in violation" if "violations" in film.figures else ""
    film.title = f"{title}: episode {seed}, return {film.figures['return']:.1f}{hurt}"
    return film


def encode(films: Sequence[Film], fps: float, speed: float) -> bytes:
    """An endless animated WebP of at most `MOST_BYTES`; half of the frames go until it fits.

    Args:
        films: Shown side by side, each with at least one frame; where one ends early, its last frame stays.
        fps: Control steps per second of the task.
        speed: Times real time.
    """
    stride = max(film.stride for film in films)
    steps = max(len(film.changed) for film in films)
    while True:
        pictures = [_side_by_side(films, at) for at in range(0, max(steps, 1), stride)]
        data = io.BytesIO()
        pictures[0].save(
            data,
            "WEBP",
            save_all=True,
            append_images=pictures[1:],
            duration=max(1, round(1000 * stride / (fps * speed))),
            loop=0,
            quality=_QUALITY,
            method=3,
        )
        if data.tell() <= MOST_BYTES or len(pictures) == 1:
            return data.getvalue()
        stride *= 2


def first_frame(animation: bytes) -> bytes:
    """The still picture for those who asked their system for less motion, and for paper."""
    data = io.BytesIO()
    with Image.open(io.BytesIO(animation)) as picture:
        picture.convert("RGB").save(data, "WEBP", quality=_QUALITY)
    return data.getvalue()


def _side_by_side(films: Sequence[Film], step: int) -> Image.Image:
    """Every film's picture of a step."""
    parts = [_picture(film, step) for film in films]
    width = sum(part.width for part in parts) + _GAP * (len(parts) - 1)
    whole = Image.new("RGB", (width, max(part.height for part in parts)), _COLORS["now"])
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
    top = TITLE if film.title else 0
    whole = Image.new("RGB", (picture.width, top + picture.height + STRIP), _COLORS["now"])
    ImageDraw.Draw(whole).text((4, 3), film.title, _COLORS["title"], ImageFont.load_default(size=15))
    whole.paste(picture, (0, top))
    whole.paste(Image.fromarray(np.tile(row[None], (STRIP, 1, 1))), (0, top + picture.height))
    return whole
