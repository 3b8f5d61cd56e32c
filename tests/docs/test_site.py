"""The built site and its pictures: complete, without warnings, and nothing in them comes from elsewhere."""

import inspect
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import safe_wrappers as sw
from safe_wrappers import info as interventions

DOCS = Path(__file__).parents[2] / "docs"
LOADED = r"<(?:script|img|iframe|source)\b[^>]*\ssrc=\"([^\"]+)\"|<link\b[^>]*\shref=\"([^\"]+)\""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    for needed in ("sphinx", "furo", "myst_parser", "latex2mathml", "matplotlib", "stable_baselines3"):
        pytest.importorskip(needed)
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-b", "html", "-E", "-W", "--keep-going", "-q", DOCS, folder],
        capture_output=True,
        text=True,
        env={**os.environ, "MUJOCO_GL": "disabled"},
    )
    assert done.returncode == 0, done.stderr
    assert all("compiling for this machine" in line for line in done.stderr.splitlines()), done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site):
    return {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site, pages):
    for path, page in pages.items():
        for address in (a or b for a, b in re.findall(LOADED, page)):
            assert not urlsplit(address).scheme and not address.startswith("//"), (path, address)
            assert (path.parent / unquote(urlsplit(address).path)).exists(), (path, address)
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert "@import" not in text and "url(http" not in text and "url(//" not in text, sheet


@pytest.mark.slow
def test_every_info_key_is_explained(site):
    shown = (site / "info.html").read_text(encoding="utf-8")
    constants = {k: v for k, v in vars(interventions).items() if k.isupper() and isinstance(v, str)}
    keys = {v for k, v in constants.items() if not k.endswith("PREFIX")}
    assert {key for key in keys if f">{key}<" not in shown} == set()


PUBLIC = {f"safe_wrappers.{name}": getattr(sw, name) for name in sw.__all__}
TOPICS = [name for name, thing in PUBLIC.items() if inspect.ismodule(thing)]
PUBLIC |= {
    f"{topic}.{name}": getattr(PUBLIC[topic], name) for topic in TOPICS for name in PUBLIC[topic].__all__
}
"""Every public name and what it stands for: those at the top, and those of the modules by topic."""


@pytest.mark.slow
def test_every_public_name_is_in_the_api(pages):
    documented = {
        name.split(".")[-1]
        for page in pages.values()
        for name in re.findall(r'id="(safe_wrappers\.[^"]+)"', page)
    }
    public = {
        name.split(".")[-1] for name, thing in PUBLIC.items() if isinstance(thing, type) or callable(thing)
    }
    assert public - documented == set()


# Pictures ---------------------------------------------------------------------------------------------------------


def test_every_picture_is_shown_and_every_shown_picture_exists():
    pytest.importorskip("matplotlib")
    drawing = runpy.run_path(str(DOCS / "figures" / "draw.py"))
    shown = {
        name
        for page in DOCS.rglob("*.md")
        for name in re.findall(r"^```\{drawn\} (\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert set(drawing["names"]()) == shown
