"""Every page's code runs and prints what it says, what it promises holds, and the site is whole by itself."""

import html
import inspect
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from unittest import mock
from urllib.parse import unquote, urlsplit

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import info as interventions

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = runpy.run_path(str(DOCS / "pages.py"))
OPTIONAL = {
    "stable_baselines3": "stable_baselines3",
    "sb3_contrib": "sb3_contrib",
    r"safe_wrappers\.sb3": "stable_baselines3",
    "gymnasium_robotics": "gymnasium_robotics",
}
"""What a page may import beyond the library's own dependencies, and what has to be there for it."""


# A simulator that is checked for two seconds says how far it came, which a busy machine decides.
@pytest.mark.filterwarnings("error::UserWarning", "ignore:the simulation of .* was compared")
@pytest.mark.parametrize("page", PAGES["pages"]())
def test_a_page_s_code_runs_and_prints_what_the_page_says(page, tmp_path, monkeypatch):
    for module in OPTIONAL:
        if re.search(rf"^(import|from) {module}\b", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE):
            pytest.importorskip(OPTIONAL[module])
    monkeypatch.chdir(tmp_path)
    with mock.patch.dict(gym.registry):  # what a page registers is gone afterwards
        PAGES["run"](page)


def test_every_python_block_of_every_page_is_run():
    for page in PAGES["pages"]():
        text = (DOCS / page).read_text(encoding="utf-8")
        assert len(PAGES["blocks"](page)) == len(
            re.findall(r"^\s*`{3,}\s*(python|pycon|py)\b", text, re.MULTILINE)
        )


def anchors(page: Path) -> set[str]:
    """As GitHub and the site make them from headings, and those that stand before one."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    made = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return made | set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))


def test_every_link_and_every_included_file_is_there():
    others = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "examples/README.md")
    missing = []
    for page in (*sorted(DOCS.rglob("*.md")), *(ROOT / name for name in others)):
        text = page.read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)\s]+)\)", text):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            of_page = anchor and target.suffix == ".md"
            if "://" not in link and not (target.exists() and (not of_page or anchor in anchors(target))):
                missing.append((page, link))
        named = re.findall(r"\{(?:include|image)\} (\S+)", text)
        missing += [(page, name) for name in named if not (page.parent / name).exists()]
    assert missing == []


@pytest.mark.parametrize("folder", ["constraints", "wrappers"])
def test_every_constraint_and_wrapper_has_a_heading_of_its_own(folder):
    headings = {
        heading
        for page in (DOCS / folder).glob("*.md")
        for heading in re.findall(r"^#+ (\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    space = sw if folder == "wrappers" else sw.constraints
    kind = gym.Wrapper if folder == "wrappers" else sw.Constraint
    things = {name: getattr(space, name) for name in space.__all__}
    assert {name for name, x in things.items() if isinstance(x, type) and issubclass(x, kind)} <= headings


# The examples for envs without MuJoCo, in closed loop, against hostile drivers --------------------------------------

DRIVERS = {
    "bang-bang": lambda k, speed: 2.0 if k // 7 % 2 else -2.0,
    "faster": lambda k, speed: np.copysign(2.0, speed),
}


def drive(env, driver):
    """Speeds after every step of one episode, and how many of its steps were flagged."""
    env.reset(seed=0)
    speeds, flagged, truncated = [], 0, False
    while not truncated:
        action = np.array([DRIVERS[driver](len(speeds), env.unwrapped.state[1])], np.float32)
        *_, truncated, info = env.step(action)
        speeds.append(abs(env.unwrapped.state[1]))
        flagged += bool(info.get("cbf/infeasible") or info.get("cbf/fallback"))
    return np.array(speeds), flagged


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize(
    ("page", "until", "limit"), [("quickstart.md", "plant", 2.0), ("../README.md", "slow", 6.0)]
)
def test_the_limit_of_the_first_example_holds(driver, page, until, limit):
    filtered = PAGES["run"](page, until=until)["env"]
    free = gym.make(filtered.unwrapped.spec.id, **filtered.unwrapped.spec.kwargs)
    speeds, flagged = drive(filtered, driver)
    assert speeds.max() <= limit and flagged == 0 and len(speeds) == 200
    assert (drive(free, driver)[0] > limit).sum() > 20


# The built site and its pictures: complete, without warnings, and nothing in them comes from elsewhere --------------

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
    return folder, {path: path.read_text(encoding="utf-8") for path in folder.rglob("*.html")}


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site):
    folder, pages = site
    for path, page in pages.items():
        for address in (html.unescape(a or b) for a, b in re.findall(LOADED, page)):
            assert not urlsplit(address).scheme and not address.startswith("//"), (path, address)
            assert (path.parent / unquote(urlsplit(address).path)).exists(), (path, address)
    for sheet in folder.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert "@import" not in text and "url(http" not in text and "url(//" not in text, sheet


@pytest.mark.slow
def test_every_info_key_and_every_public_name_is_explained(site):
    folder, pages = site
    constants = {k: v for k, v in vars(interventions).items() if k.isupper() and isinstance(v, str)}
    keys = {v for k, v in constants.items() if not k.endswith("PREFIX")}
    assert {key for key in keys if f">{key}<" not in pages[folder / "info.html"]} == set()
    things = {name: getattr(sw, name) for name in sw.__all__}
    for topic in filter(inspect.ismodule, [*things.values()]):
        things |= {name: getattr(topic, name) for name in topic.__all__}
    documented = {
        name for page in pages.values() for name in re.findall(r'id="safe_wrappers\.(?:\w+\.)*(\w+)"', page)
    }
    assert {name for name, thing in things.items() if callable(thing)} - documented == set()


def test_every_picture_is_shown_and_every_shown_picture_exists():
    pytest.importorskip("matplotlib")
    drawing = runpy.run_path(str(DOCS / "figures" / "draw.py"))
    shown = {
        name
        for page in DOCS.rglob("*.md")
        for name in re.findall(r"^```\{drawn\} (\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert set(drawing["names"]()) == shown
