"""The documentation's pictures: drawn from the library, the same every time, in colours that the page sets."""

import re
import runpy
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
DOCS = Path(__file__).parents[2] / "docs"
DRAW = runpy.run_path(str(DOCS / "figures" / "draw.py"))
SHOWN = {
    name
    for page in DOCS.rglob("*.md")
    for name in re.findall(r"^```\{drawn\} (\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
}


def draw(name):
    code = (DOCS / "figures" / f"{name}.py").read_text(encoding="utf-8")
    for module in ("stable_baselines3", "gymnasium_robotics"):
        if module in code:
            pytest.importorskip(module)
    return DRAW["svg"](name)


def test_every_picture_is_shown_and_every_shown_picture_exists():
    assert set(DRAW["names"]()) == SHOWN


LONG = {"whole_body_filter", "teleop_channel", "contact_feasibility"}
"""They drive a robot for as long as 20 seconds."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in DRAW["names"]()]
)
def test_a_picture_takes_its_colours_from_the_page_and_nothing_from_elsewhere(name):
    picture = draw(name)
    colours = set(re.findall(r"(?:fill|stroke): ([^;\"]+)", picture))
    assert {c for c in colours if not c.startswith("var(--drawn-")} <= {"none"}
    assert "var(--drawn-ink" in picture
    links = re.findall(r"(?:href|src)=\"([^\"]+)\"|url\(([^)]+)\)", picture)
    assert all((a or b).startswith("#") for a, b in links)
    assert re.search(r"<(script|image|style>[^<]*@import)", picture) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAW["names"]())
def test_a_picture_is_the_same_every_time(name):
    assert draw(name) == draw(name)
