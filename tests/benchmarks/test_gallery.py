"""The gallery: small films that move, of every scene, and a page that has the numbers that were counted."""

import json

import numpy as np
import pytest

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

from benchmarks import gallery  # noqa: E402
from benchmarks.cases import PROTECTED  # noqa: E402


def test_the_films_are_all_there_small_and_moving():
    films = {path.stem: path for path in gallery.FILMS.glob("*.webp")}
    assert films.keys() == gallery.SCENES.keys()
    readmes = gallery.FILMS.parent / "filter.webp"
    assert sum(path.stat().st_size for path in (*films.values(), readmes)) < 3_000_000
    for path in films.values():
        with Image.open(path) as film:
            assert film.n_frames > gallery.FRAMES / 2  # equal ones are kept once
            assert film.size == (2 * gallery.PANEL + gallery.GAP, gallery.HEAD + gallery.PANEL + gallery.FOOT)


def test_the_page_is_what_the_counts_make():
    counts = json.loads(gallery.COUNTS.read_text())
    assert gallery.PAGE.read_text(encoding="utf-8") == gallery.page(counts)
    for counted in counts.values():
        assert counted["off"]["steps"] == counted["on"]["steps"] > 0
        assert counted["off"]["changed"] == 0 < counted["off"]["violations"]  # there was something to prevent
        assert counted["on"]["violations"] == 0 < counted["on"]["changed"]


@pytest.mark.parametrize("name", gallery.SCENES)
def test_every_scene_names_a_driver_of_its_case(name):
    scene = gallery.SCENES[name]
    assert scene.maker is PROTECTED[scene.case].drivers[scene.driver]


def test_the_judge_s_verdict_is_in_info():
    case = PROTECTED["SafePointGoal1-v0"]
    env = gallery.Judged(case.make(), case)
    raw = env.unwrapped
    env.reset(
        seed=0, options={"layout": {"agent": [0, 0, 0], "goal": [1, 1], "hazards": [[0, 0]], "vases": []}}
    )
    *_, info = env.step(np.zeros(2))
    assert info["cost_substep"] == 1.0
    env.reset(
        seed=0, options={"layout": {"agent": [0, 0, 0], "goal": [1, 1], "hazards": [[1, 0]], "vases": []}}
    )
    *_, info = env.step(np.zeros(2))
    assert info["cost_substep"] == 0.0
    assert raw is env.env.unwrapped

    class Missed:
        def start(self):
            return 0.0

        def before(self):
            pass

        def after(self, executed, info):
            return float("nan")

    env._judge = Missed()
    *_, info = env.step(np.zeros(2))
    assert info["cost_substep"] == 1.0  # what is not a number is a violation


def test_only_one_side_is_filtered(monkeypatch):
    """No frame is drawn: the counts of a few steps."""
    monkeypatch.setattr(gallery.Side, "frame", lambda side: Image.new("RGB", (1, 1)))
    monkeypatch.setattr(gallery, "FRAMES", 20)
    frames, times, counts = gallery.film(gallery.SCENES["reacher"])
    assert len(frames) == 20
    assert times == pytest.approx(1000 * 2 * 0.02 / gallery.FRAME_MS)
    assert counts["off"].steps == counts["on"].steps == 40
    assert counts["off"].changed == counts["on"].violations == 0
    assert counts["off"].violations > 0 < counts["on"].changed
