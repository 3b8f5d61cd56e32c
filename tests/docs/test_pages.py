"""Every page's code runs, and prints what the page says; every link leads somewhere."""

import re
import runpy
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest

import safe_wrappers as sw

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


@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("page", PAGES["pages"]())
def test_a_page_s_code_runs_and_prints_what_the_page_says(page, tmp_path, monkeypatch):
    for module in OPTIONAL:
        if re.search(rf"^(import|from) {module}\b", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE):
            pytest.importorskip(OPTIONAL[module])
    monkeypatch.chdir(tmp_path)
    with mock.patch.dict(gym.registry):  # what a page registers is gone afterwards
        PAGES["run"](page)


@pytest.mark.parametrize("page", PAGES["pages"]())
def test_every_python_block_of_a_page_is_run_and_fits_on_it(page):
    text = (DOCS / page).read_text(encoding="utf-8")
    found = PAGES["blocks"](page)
    assert len(found) == len(re.findall(r"^\s*`{3,}\s*(python|pycon|py)\b", text, re.MULTILINE))
    assert max(len(line) for block in found for line in block.code.splitlines()) <= 88


def anchors(page: Path) -> set[str]:
    """As GitHub and the site make them from headings, and those that stand before one."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    made = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return made | set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))


WITH_LINKS = [
    *sorted(DOCS.rglob("*.md")),
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "examples/README.md")),
]


@pytest.mark.parametrize("page", WITH_LINKS, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_and_every_included_file_is_there(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        if "://" in link:
            continue
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or target.suffix != ".md" or anchor in anchors(target), link
    for name in re.findall(r"\{(?:include|image)\} (\S+)", text):
        assert (page.parent / name).exists(), name


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


def test_the_readme_is_one_page():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130
