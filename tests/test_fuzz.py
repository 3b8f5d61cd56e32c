"""The default profile draws the same in every run; `make fuzz` draws others, and tells what failed."""

import os
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
