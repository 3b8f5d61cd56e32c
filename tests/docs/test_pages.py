"""Every page's code runs, and prints what the page says."""

import re
import runpy
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest

import safe_wrappers  # noqa: F401  (its ids must outlast the first page)

DOCS = Path(__file__).parents[2] / "docs"
PAGES = runpy.run_path(str(DOCS / "pages.py"))
OPTIONAL = {
    "stable_baselines3": "stable_baselines3",
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


@pytest.mark.parametrize(
    ("block", "failure"),
    [
        ("```python\nprint(1 + 1)\n```\n\n```text\n3\n```\n", AssertionError),
        ("```python\nprint(1 + 1)\n```\n\nSome words.\n", AssertionError),
        ("```python\nundefined\n```\n", NameError),
    ],
)
def test_a_page_that_says_something_else_than_its_code_does_fails(tmp_path, block, failure):
    page = tmp_path / "page.md"
    page.write_text("# A page\n\n```python\na = 1\n```\n\n" + block)
    with pytest.raises(failure):
        PAGES["run"](str(page))


def test_blocks_share_their_names_and_stop_where_asked(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```python\na = 1\n```\n\n```python\nb = a + 1\nprint(b)\n```\n```text\n2\n```\n```python\nc = 1\n```\n"
    )
    names = PAGES["run"](str(page), until="b")
    assert names["b"] == 2 and "c" not in names
    assert [block.line for block in PAGES["blocks"](str(page))] == [2, 6, 13]


@pytest.mark.parametrize("page", ["own-constraint", "own-backup-manoeuvre"])
def test_a_constraint_of_ones_own_takes_at_most_forty_lines(page):
    written = [
        block.code for block in PAGES["blocks"](f"tutorial/{page}.md") if "sw.Constraint" in block.code
    ]
    assert written
    assert all(len([line for line in code.splitlines() if line.strip()]) <= 40 for code in written)
