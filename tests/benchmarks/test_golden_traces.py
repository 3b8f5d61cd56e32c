"""The golden traces: what the protected envs did when they were recorded, they do today, bit for bit."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import golden_traces
from benchmarks.golden_traces import (
    NOT_COMPARABLE,
    RECORDED,
    SAME_BITS,
    SHORT,
    TOLERANCES,
    differences,
    misbehaviour,
    runs,
)


def compare(*words):
    """In the environment that it would make for itself, and in one process: others run tests beside it."""
    line = [sys.executable, "-m", "benchmarks.golden_traces", "--workers", "1", *words]
    done = subprocess.run(line, capture_output=True, text=True, env=os.environ | SAME_BITS)
    if done.returncode == NOT_COMPARABLE:
        pytest.skip(done.stdout.strip())
    return done


def test_three_envs_do_what_they_did():
    done = compare("--short")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("12 runs of 500 steps are equal bit for bit")


@pytest.mark.slow
def test_every_env_does_what_it_did():
    done = compare()
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_env_is_recorded_and_most_are_filtered():
    recorded = json.loads(RECORDED.read_text())["runs"]
    assert {run.partition(";")[0] for run in recorded} == set(runs())
    assert len(recorded) == 4 * len(runs()) and set(SHORT) <= set(runs())
    intervened = {run.partition(";")[0] for run, found in recorded.items() if found["behaviour"]["changed"]}
    # No limit binds on the goal tasks without cost; a lease alone and a channel have no filter to intervene.
    idle = {
        "SafePointGoal0-v0",
        "SafeCarGoal0-v0",
        "SafeHumanoidVelocity-v0",
        "SafePointGoal1, late commands",
    }
    assert set(runs()) - intervened == idle | {
        "InvertedPendulum, a lease alone",
        "TeleopContact, over a network",
    }


def test_a_bit_that_differs_is_found(monkeypatch):
    make, driver, _ = runs()["Reacher-v5"]
    monkeypatch.setattr(golden_traces, "STEPS", 100)
    before = golden_traces.trace(make, driver["random"], 0)

    def nudged():
        env = make()
        step, count = env.step, iter(range(1_000))

        def other(action):
            observation, reward, *rest = step(action)
            return observation, np.nextafter(reward, 1.0) if next(count) == 70 else reward, *rest

        env.step = other
        return env

    after = golden_traces.trace(nudged, driver["random"], 0)
    assert differences({"run": before}, {"run": golden_traces.trace(make, driver["random"], 0)}) == []
    assert differences({"run": before}, {"run": after}) == ["run: reward differs from steps 50 to 100 on"]
    assert differences({}, {"run": after}) == ["run: was not recorded"]
    del after["digests"]["reward"]
    assert differences({"run": before}, {"run": after}) == ["run: reward is gone"]


def test_another_behaviour_is_found_and_chance_is_allowed_for():
    def run(**figures):
        return {"behaviour": dict.fromkeys(TOLERANCES, 0.0) | {"violations": None} | figures}

    seeds = {"a; random; seed 0": run(changed=0.2), "a; random; seed 1": run(changed=0.25)}
    (name, _) = seeds
    assert misbehaviour(seeds, seeds) == []
    assert misbehaviour(seeds, {name: run(changed=0.26)}) == []
    assert misbehaviour(seeds, {name: run(changed=0.3)}) == [f"{name}: changed was 0.2, is 0.3"]
    found = misbehaviour(seeds, {name: run(changed=0.2, infeasible=0.006, violations=0.0)})
    assert found == [f"{name}: infeasible was 0, is 0.006", f"{name}: violations was None, is 0.0"]


def test_other_arithmetic_is_not_compared(tmp_path, monkeypatch, capsys):
    recorded = json.loads(RECORDED.read_text())
    recorded["arithmetic"]["probe"] = "00"
    (tmp_path / "other.json").write_text(json.dumps(recorded))
    for name, value in SAME_BITS.items():
        monkeypatch.setenv(name, value)  # so that it runs here
    monkeypatch.setattr(sys, "argv", ["golden_traces", "--short", "--recorded", str(tmp_path / "other.json")])
    with pytest.raises(SystemExit) as end:
        golden_traces.main()
    assert end.value.code == NOT_COMPARABLE and capsys.readouterr().out.startswith("not comparable: ")
