"""The README's moving picture: small, animated, and described with the numbers that were counted."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

from benchmarks import moving_picture  # noqa: E402

ROOT = Path(__file__).parents[2]


def test_the_film_is_small_and_moves():
    assert moving_picture.FILM.stat().st_size < 2_000_000
    with Image.open(moving_picture.FILM) as film:
        assert film.n_frames > 100 and film.size[0] == 2 * moving_picture.PANEL + moving_picture.GAP


@pytest.mark.parametrize("page", ["README.md", "docs/results/goal-tasks.md"])
def test_its_caption_has_the_numbers_that_were_counted(page):
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    alone, filtered = json.loads(moving_picture.COUNTS.read_text()).values()
    assert alone["episodes"] == filtered["episodes"] == len(moving_picture.COUNTED) == 100
    assert f"{alone['violations']:,} of {alone['steps']:,} steps" in text and filtered["violations"] == 0
    assert f"{alone['goals']} goals" in text and re.search(rf"\b{filtered['goals']}\b", text)
    assert re.search(rf"{filtered['changed'] / filtered['steps']:.0%}".replace("%", " ?%"), text)


def test_both_sides_meet_the_same_episodes_and_only_one_is_filtered(monkeypatch):
    monkeypatch.setattr(moving_picture, "COUNTED", range(1))
    monkeypatch.setattr(moving_picture, "ENV_ID", "SafePointGoal2-v0")
    alone, filtered = moving_picture.whole_episodes(lambda observation: np.array([1.0, 0.3])).values()
    assert alone["steps"] == filtered["steps"] == 1000
    assert alone["changed"] == filtered["violations"] == 0 < alone["violations"]
    assert filtered["changed"] > 0


def test_thestrip_shows_what_happened_so_far():
    strip = moving_picture.strip([(False, False), (True, False), (True, True), (False, True)], 2)
    colours = [strip.getpixel((x, 0)) for x in (50, 150, 250, 350)]
    assert colours == [
        moving_picture.BARE,
        moving_picture.CHANGED,
        moving_picture.VIOLATED,
        moving_picture.BARE,
    ]
