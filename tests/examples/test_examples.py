"""Every script of `examples/` runs with few steps and shows what it says; every notebook prints what it stores."""

import contextlib
import io
import json
import re
import runpy
import sys
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest

import safe_wrappers  # noqa: F401  (its ids must outlast the first script)

pytest.importorskip("stable_baselines3")
torch = pytest.importorskip("torch")

EXAMPLES = Path(__file__).parents[2] / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
STEPS_AND_WORDS = {
    "protect_ppo": (64, r"return -?[\d.]+, steps in violation 0\n\d+% of the actions changed"),
    "sac_executed_actions": (40, r"^40 steps stored, each with the action that the filter executed"),
    "her_fetch": (102, r"^[0-5] of 5 goals reached; the smallest margin was 0\.\d+ m"),
    "chunk_policy": (16, r"fastest change of a command: [\d.]+ per second, limit 25\.0"),
    "lease_outages": (
        400,
        r"no lease: (\d+) silent steps, 0 braked, [1-9]\d* .*\nlease: \1 .*, [1-9]\d* braked, 0 ",
    ),
    "slip_rover": (
        150,
        r"as it is: [\d.]+ m, largest slip 0\.[6-9]\d\nlimited: [\d.]+ m, largest slip 0\.1\d",
    ),
    "occlusion": (40, r"cars in sight \d+% of the time, penalty [\d.]+, [1-9]\d* of 40 actions changed"),
    "own_env": (100, r"^Ferry: over the weir\nCBFActionFilter: holds at 0\.00 m"),
    "vector_env": (512, r"^\d+ actions changed, cost 0, last rewards"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", STEPS_AND_WORDS)
def test_it_runs_and_shows_what_it_says(name, tmp_path, capsys, monkeypatch):
    if name == "her_fetch":
        pytest.importorskip("gymnasium_robotics")
    monkeypatch.chdir(tmp_path)
    steps, words = STEPS_AND_WORDS[name]
    torch.set_num_threads(1)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--steps", str(steps)])
    with mock.patch.dict(gym.registry):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    out = capsys.readouterr().out
    assert re.search(words, out), out
    assert not list(tmp_path.iterdir()), "it leaves nothing behind"


def test_every_script_and_notebook_is_in_the_table():
    table = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert {path.stem for path in EXAMPLES.glob("*.py")} == STEPS_AND_WORDS.keys()
    assert all(f"({path.relative_to(EXAMPLES)})" in table for path in (*EXAMPLES.glob("*.py"), *NOTEBOOKS))


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
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    with mock.patch.dict(gym.registry):
        for number, (code, stored) in enumerate(cells):
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(code, f"{path.name}, code cell {number}", "exec"), names)
            assert printed.getvalue() == stored, f"code cell {number}"
