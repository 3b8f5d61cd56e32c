"""The golden traces: what the protected envs did when they were recorded, they do today, bit for bit."""

import json
import os
import subprocess
import sys

import pytest

from benchmarks.golden_traces import NOT_COMPARABLE, RECORDED, SAME_BITS, SHORT, runs


def compare(*words):
    """In the environment that it would make for itself, and in one process: others run tests beside it."""
    line = [sys.executable, "-m", "benchmarks", "golden_traces", "--workers", "1", *words]
    done = subprocess.run(line, capture_output=True, text=True, env=os.environ | SAME_BITS)
    if done.returncode == NOT_COMPARABLE:
        pytest.skip(done.stdout.strip())
    return done


def test_three_envs_do_what_they_did():
    done = compare("--short")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("6 runs of 500 steps are equal bit for bit")


@pytest.mark.slow
def test_every_env_does_what_it_did():
    done = compare()
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_env_is_recorded_and_most_are_filtered():
    recorded = json.loads(RECORDED.read_text())["runs"]
    assert {run.partition(";")[0] for run in recorded} == set(runs())
    assert len(recorded) == 4 * len(runs()) and set(SHORT) <= set(runs())
    # No limit binds on the goal tasks without cost; a lease alone and a channel have no filter to intervene.
    assert sum(bool(found["behaviour"]["changed"]) for found in recorded.values()) > 2 * len(runs())
