"""The table of pyramids and cones: its counts on problems with known answers, its recording, its command."""

import json
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks import friction_cones
from benchmarks.friction_cones import EXACT, SHARE, SOLVERS, at, compare, record, table
from safe_wrappers.control.legged.whole_body import rigid_forces
from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem


def foot(nominal, wanted=0.0):
    """Two kilograms on a floor of friction 0.5, pushed by three motors of 30 N."""
    return WholeBodyProblem(
        2.0 * np.eye(3), np.array([0, 0, 19.62]), np.eye(3), np.eye(3)[None], np.zeros((1, 3)),
        np.array([[0, 0, 1.0]]), np.array([0.5]), -np.full(3, 30.0), np.full(3, 30.0), np.array(nominal, float),
        contact_acceleration=np.array([[0, 0, wanted]]), first_tangents=np.array([[1.0, 0, 0]]),
        control_weight=np.array([1.0, 1.0, 1e6]),
    )  # fmt: skip


def test_counts_are_those_of_problems_with_known_answers():
    # Left alone by all; halfway between two edges, where four edges give away 29 %; sinking faster than motors pull.
    easy, hard, none = foot([1.0, 0, 0]), foot([14.0, 14.0, 0]), foot([0, 0, 0], -40.0)
    rows = compare([easy, hard, none], repeats=1)
    assert set(rows) == set(SOLVERS)
    for row in rows.values():
        assert (row["problems"], row["admitted"], row["infeasible"], row["failed"]) == (3, 1, 1, 0)
        assert row["lost"] == row["gained"] == 0
        assert len(row["us"]) == 3 and row["us"][0] > 1.0
    radius = 0.5 * 19.62
    given_away = radius * (1.0 - np.cos(np.pi / 4))
    assert rows["4 edges, daqp"]["farther"][0] == pytest.approx(given_away, abs=1e-3)
    assert rows["4 edges, daqp"]["apart"][0] == pytest.approx(given_away / np.sqrt(2.0), abs=1e-3)
    assert rows["8 edges, daqp"]["farther"][0] == pytest.approx(0.0, abs=1e-4)  # an edge points there
    assert rows[EXACT]["farther"] == [0.0, 0.0, 0.0]


def test_what_the_pyramid_loses_is_counted():
    # Motors too weak to take back the 3 N that the pyramid lacks halfway between two edges.
    lower = np.array([6.0, 6.0, -0.1])
    problem = replace(foot([0, 0, 0]), lower=lower, upper=lower + 0.2, nominal=lower + 0.1)
    rows = compare([problem], repeats=1)
    assert rows["4 edges, daqp"]["lost"] == 1 and rows["4 edges, daqp"]["infeasible"] == 1
    assert rows["8 edges, daqp"]["lost"] == 0 and rows[EXACT]["lost"] == 0
    assert rows["4 edges, daqp"]["farther"] is None
    printed = table([{"robot": "Foot", "policy": "none", "solver": name} | row for name, row in rows.items()])
    assert "| Foot | none | 1.0, 1 | 4 edges, daqp | 0.0% | 100.0% | 0 | 100.0% | - | - |" in printed


@pytest.mark.parametrize("robot", ["Ant", "Humanoid"])
def test_recorded_problems_are_the_robots(robot):
    problems = list(record(robot, "random", 6, seed=1))
    assert len(problems) == 6
    again = list(record(robot, "random", 6, seed=1))
    for one, other in zip(problems, again, strict=True):
        assert (one.inertia == other.inertia).all() and (one.nominal == other.nominal).all()
        assert ((one.nominal >= one.lower) & (one.nominal <= one.upper)).all()
        assert one.stance.size > 0
        assert set(np.round(one.friction, 9)) <= {0.0, SHARE}
        forces, _ = rigid_forces(one, one.nominal)
        assert np.isfinite(forces).all() and not forces[one.opening].any()
    env = gym.make(f"{robot}-v5")
    plant = sw.MujocoPlant()
    plant.bind(env)
    env.reset(seed=0)
    env.unwrapped.data.qpos[2] += 3.0
    plant.observe()
    assert at(plant, np.zeros(env.action_space.shape)) is None  # in the air


def test_the_command_prints_and_keeps_the_table(tmp_path, monkeypatch, capsys):
    def untrained(robot):
        raise sw.errors.ConfigurationError("not trained")

    monkeypatch.setattr(friction_cones, "learned", untrained)
    monkeypatch.setattr(
        sys, "argv", ["friction_cones", "--robots", "Ant", "--problems", "3", "--results", str(tmp_path)]
    )
    friction_cones.main()
    printed = capsys.readouterr().out
    assert "no policy 'learned' here" in printed
    kept = json.loads((tmp_path / "friction_cones.json").read_text())
    assert len(kept) == 2 * len(SOLVERS)
    assert {row["policy"] for row in kept} == {"standing", "random"}
    assert (tmp_path / "friction_cones.md").read_text().strip().splitlines()[-1] in printed
