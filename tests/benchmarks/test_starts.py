"""`python -m benchmarks.starts` counts resets that leave an env outside the safe set."""

import json
import sys
from dataclasses import replace

import pytest

import safe_wrappers as sw
from benchmarks import judges, starts
from benchmarks.cases import CASES


def test_the_command_prints_a_row_per_env(monkeypatch, capsys, tmp_path):
    words = ["starts", "--resets", "5", "--envs", "Swimmer", "Reacher", "--results", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    starts.main()
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in out.splitlines()[2:]]
    assert [row[:4] for row in rows] == [
        ["Reacher-v5", "5", "0", "0"],
        ["SafeSwimmerVelocity-v0, Swimmer-v5", "5", "0", "0"],
    ]
    assert (tmp_path / "starts.md").read_text() == out
    assert [row["unsafe"] for row in json.loads((tmp_path / "starts.json").read_text())] == [0, 0]


def test_unsafe_starts_are_counted_by_the_filter_and_by_the_judge():
    # A Reacher's joints start with up to 0.005 rad/s: most are above a limit of 0.002.
    case = replace(
        CASES["Reacher-v5"],
        protect=lambda env: sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(limit=0.002)]),
        judge=lambda env: judges.Replay(env, judges.joints_too_fast(env.model, 0.002)),
    )
    found = starts.measure(case, resets=40)
    assert 20 < found["unsafe"] == found["violated"] < 40
    assert -0.003 - 1e-6 <= found["smallest"] < -0.001


def test_nothing_to_measure_names_the_envs(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["starts", "--envs", "Recher"])
    with pytest.raises(SystemExit):
        starts.main()
    assert "Reacher-v5" in capsys.readouterr().err
