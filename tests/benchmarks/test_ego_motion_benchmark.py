"""The ego-motion benchmark: its errors against the env's truth, its files."""

import json
import sys

import gymnasium as gym
import numpy as np
import pytest

from benchmarks import ego_motion
from benchmarks.tracked import CROSSING, crossing


def test_the_table_says_what_was_driven_and_the_arm_decides(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ego_motion, "STEPS", 100)
    monkeypatch.setattr(sys, "argv", ["ego_motion", "--episodes", "1", "--results", str(tmp_path)])
    ego_motion.main()
    rows = json.loads((tmp_path / "ego_motion.json").read_text())
    assert len(rows) == 8 and {row["steps"] for row in rows} == {100}
    lines = (tmp_path / "ego_motion.md").read_text().splitlines()
    assert len(lines) == 10 and lines[2].startswith("| compensated | none | at the reset | 100 |")
    assert "every 2 s" in lines[4] and lines[0] in capsys.readouterr().out
    for with_arm, without in zip(rows[::2], rows[1::2], strict=True):
        assert with_arm["lever_arm"] and not without["lever_arm"]
        assert with_arm["largest_m"] < 0.3 * without["largest_m"]


def test_errors_are_of_the_body_against_the_envs_truth(monkeypatch):
    monkeypatch.setattr(ego_motion, "STEPS", 1)
    found = ego_motion.drive(False, True, None, 1)
    env = crossing(
        gym.make("OccludedCrossing-v0"),
        sensor=CROSSING["sensor"] | {"imu": {"site": "eye", "lever_arm": False} | ego_motion.NOISE},
    )
    env.reset(seed=0)
    action = ego_motion.DRIVERS["goal-seeking"](env.unwrapped, np.random.default_rng(0))()
    env.step(np.array([action[0], action[1], np.random.default_rng(0).uniform(-1.0, 1.0)]))
    off = np.linalg.norm(env.ego_motion.position[:2] - env.unwrapped.agent_position)
    assert found["largest_m"] == found["median_m"] == pytest.approx(off, rel=1e-12)
