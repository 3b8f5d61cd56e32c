"""The projection is compiled, or loaded, where a filter is made: no control step waits for it."""

import subprocess
import sys

import pytest

from safe_wrappers.control.numerics.compiled import IS_COMPILED

SCRIPT = """
import gymnasium as gym
import safe_wrappers as sw
from safe_wrappers.filter.rows_and_box import keep_rows, row_slacks

def ready():
    return len(keep_rows.signatures), len(row_slacks.signatures)

env = sw.protect(gym.make("Reacher-v5"))
before = ready()
env.reset(seed=0)
changed = sum(env.step(env.action_space.high)[4]["cbf/intervened"] for _ in range(10))
print(before, ready(), changed > 0)
"""


@pytest.mark.skipif(not IS_COMPILED, reason="nothing is compiled in this process")
def test_a_filter_has_its_projection_before_the_first_step():
    ran = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert ran.stdout.split("\n")[0] == "(1, 1) (1, 1) True"
