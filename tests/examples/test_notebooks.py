"""Every notebook runs from top to bottom, without a kernel, and prints what is stored in it."""

import contextlib
import io
import json
import re
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest

import safe_wrappers  # noqa: F401  (its ids must outlast the first notebook)

EXAMPLES = Path(__file__).parents[2] / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))


def code_cells(path):
    """Source and stored output of each cell, as (str, str)."""
    book = json.loads(path.read_text(encoding="utf-8"))
    assert book["nbformat"] == 4 and book["nbformat_minor"] >= 5
    assert len({cell["id"] for cell in book["cells"]}) == len(book["cells"])
    for cell in book["cells"]:
        assert cell["cell_type"] in ("markdown", "code")
        if cell["cell_type"] == "code":
            assert all((out["output_type"], out["name"]) == ("stream", "stdout") for out in cell["outputs"])
            yield "".join(cell["source"]), "".join(line for out in cell["outputs"] for line in out["text"])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_prints_what_is_stored_in_it(path, tmp_path, monkeypatch):
    cells = list(code_cells(path))
    for module in ("stable_baselines3", "safe_wrappers.train"):
        if any(re.search(rf"^from {re.escape(module)}", code, re.MULTILINE) for code, _ in cells):
            pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    with mock.patch.dict(gym.registry):
        for number, (code, stored) in enumerate(cells):
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(code, f"{path.name}, code cell {number}", "exec"), names)
            assert printed.getvalue() == stored, f"code cell {number}"


def test_there_are_three_and_the_table_has_them():
    table = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 3
    assert all(f"(notebooks/{path.name})" in table for path in NOTEBOOKS)
