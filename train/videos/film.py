"""Frames of an episode become a small animated WebP with a strip below that shows when the filter acted."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from safe_wrappers.drawing.scene import set_size
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.safety_overlay import SafetyOverlay

WIDTH: Final = 640
HEIGHT: Final = 480
"""Pixels of the picture, whose width an env that MuJoCo does not draw may decide; the strip is below it."""
STRIP: Final = 16
MOST_FRAMES: Final = 120
MOST_BYTES: Final = 2_000_000
_LONGEST_S: Final = 10.0
_SHORTEST_S: Final = 4.0
_QUALITY: Final = 55
_WIDE: Final = 3  # px: half of what marks one step in the strip
_COLORS: Final = {
    "bare": (120, 128, 138),
    "changed": (240, 178, 20),
    "violated": (214, 40, 52),
    "now": (255, 255, 255),
}


def for_film(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """An env that has not been drawn yet, as films show it: as large as they are, and with what its filter does."""
    set_size(env, WIDTH, HEIGHT)
    return env if filter_inside(env) is None else SafetyOverlay(env)


@dataclass
class Film:
    """Collects frames and what happened at each step; thins itself out where the episode is longer than thought.

    Ask `wants_frame` before each step and give it one if so; tell it of every step.
    """

    frames: list[Image.Image] = field(default_factory=list)
    stride: int = 1
    changed: list[bool] = field(default_factory=list)
    violated: list[bool] = field(default_factory=list)

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


def encode(film: Film, fps: float, speed: float) -> bytes:
    """An endless animated WebP of at most `MOST_BYTES`; half of the frames go until it fits.

    Args:
        film: At least one frame.
        fps: Control steps per second of the task.
        speed: Times real time.
    """
    every = 1
    while True:
        kept = range(0, len(film.frames), every)
        pictures = [_with_strip(film, at) for at in kept]
        duration_ms = max(1, round(1000 * film.stride * every / (fps * speed)))
        data = io.BytesIO()
        pictures[0].save(
            data,
            "WEBP",
            save_all=True,
            append_images=pictures[1:],
            duration=duration_ms,
            loop=0,
            quality=_QUALITY,
            method=3,
        )
        if data.tell() <= MOST_BYTES or len(pictures) == 1:
            return data.getvalue()
        every *= 2


def first_frame(animation: bytes) -> bytes:
    """The still picture for those who asked their system for less motion, and for paper."""
    data = io.BytesIO()
    with Image.open(io.BytesIO(animation)) as picture:
        picture.convert("RGB").save(data, "WEBP", quality=_QUALITY)
    return data.getvalue()


def _with_strip(film: Film, at: int) -> Image.Image:
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
    whole = Image.new("RGB", (picture.width, HEIGHT + STRIP))
    whole.paste(picture, (0, 0))
    whole.paste(Image.fromarray(np.tile(row[None], (STRIP, 1, 1))), (0, HEIGHT))
    return whole
