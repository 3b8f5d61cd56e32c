"""The overlay's frames in the docs: there for every scene, shown, and small."""

import re
from pathlib import Path

import pytest

pytest.importorskip("gymnasium_robotics")

from PIL import Image

from benchmarks.overlay_frames import FOLDER, HEIGHT, SCENES, WIDTH

PAGE = Path(__file__).parents[2] / "docs" / "wrappers" / "safety-overlay.md"


def test_every_scene_has_a_frame_that_the_page_shows_and_no_frame_is_left_over():
    shown = re.findall(
        r"^```\{image\} \.\./static/overlay/(\w+)\.webp$", PAGE.read_text(encoding="utf-8"), re.M
    )
    assert sorted(shown) == sorted(SCENES) == sorted(path.stem for path in FOLDER.iterdir())


def test_frames_are_large_enough_to_see_and_small_enough_to_keep():
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 1_000_000
    for path in FOLDER.iterdir():
        with Image.open(path) as frame:
            assert frame.size in ((WIDTH, HEIGHT), (500, 500))  # the latter is Pendulum's own
