"""The default profile draws the same in every run; `make fuzz` draws others, and tells what failed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DRAWS = """
import runpy, sys
runpy.run_path("tests/conftest.py")
from hypothesis import given, settings, strategies as st
settings.load_profile(sys.argv[1])
drawn = []
@given(st.floats(0.0, 1.0))
def draw(x):
    drawn.append(x)
draw()
print(drawn)
"""


@pytest.mark.parametrize(
    ("profile", "server", "again"),
    # Each where hypothesis by itself would do the opposite.
    [("reproducible", {}, True), ("fuzz", {"CI": "true"}, False)],
)
def test_a_second_run_draws_the_same_or_not(profile, server, again, tmp_path):
    runs = {
        subprocess.run(
            [sys.executable, "-c", DRAWS, profile],
            env={k: v for k, v in os.environ.items() if k != "CI"}
            | server
            | {"HYPOTHESIS_STORAGE_DIRECTORY": str(tmp_path)},
            cwd=ROOT,
            check=True,
            capture_output=True,
        ).stdout
        for _ in range(2)
    }
    assert (len(runs) == 1) == again


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize("minutes, codes, rounds", [(0, "0", 1), (0, "1", 1), (1, "2", 1), (1, "02", 2)])
def test_it_goes_on_until_the_time_is_up_and_stops_where_nothing_ran(minutes, codes, rounds, tmp_path):
    """The exit codes of pytest, one per round: 0 passed, 1 failed, 2 interrupted."""
    told, stub = tmp_path / "told", tmp_path / "python"
    stub.write_text(f"#!/bin/sh\necho x >> {told}\nexit $(echo {codes} | cut -c $(wc -l < {told}))\n")
    stub.chmod(0o755)
    made = subprocess.run(
        ["make", "-o", ".venv/installed", "fuzz", f"MINUTES={minutes}", f"BIN={tmp_path}"],
        cwd=ROOT,
        capture_output=True,
    )
    assert (made.returncode == 0) == (codes == "0")
    assert len(told.read_text().split()) == rounds
