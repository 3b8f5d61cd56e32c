"""The README's moving picture: small, animated, and described with the numbers that were counted."""

import json
from pathlib import Path

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
    counts = json.loads(moving_picture.COUNTS.read_text())
    assert (
        counts["unfiltered"]["episodes"]
        == counts["filtered"]["episodes"]
        == len(moving_picture.COUNTED)
        == 100
    )
    assert counts["filtered"]["violations"] == 0
    assert moving_picture.caption(counts) in text


def test_both_sides_meet_the_same_episodes_and_only_one_is_filtered(monkeypatch):
    monkeypatch.setattr(moving_picture, "COUNTED", range(1, 2))
    counts = moving_picture.whole_episodes()
    alone, filtered = counts["unfiltered"], counts["filtered"]
    assert alone["steps"] == filtered["steps"] == 1000
    assert alone["changed"] == filtered["violations"] == 0 < alone["violations"]
    assert alone["reward"] > 15.0 and filtered["changed"] > 0


def test_the_strip_shows_what_happened_so_far():
    strip = moving_picture.strip([(False, False), (True, False), (True, True), (False, True)], 2)
    colours = [strip.getpixel((x, 0)) for x in (50, 150, 250, 350)]
    assert colours == [
        moving_picture.BARE,
        moving_picture.CHANGED,
        moving_picture.VIOLATED,
        moving_picture.BARE,
    ]
