"""What the matrix of versions is made from, against pyproject.toml read by another library, and its table."""

import csv
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from benchmarks import matrix
from benchmarks.matrix import Combination, combinations, constraints, floors, main, table

ROOT = Path(__file__).parents[2]
PROJECT, PINS = (ROOT / "pyproject.toml").read_text(), (ROOT / "constraints.txt").read_text()


def test_floors_are_those_of_the_project_and_allowed_by_it():
    tomllib = pytest.importorskip("tomllib")
    wanted = {
        r.name: r.specifier for r in map(Requirement, tomllib.loads(PROJECT)["project"]["dependencies"])
    }
    found = floors(PROJECT)
    assert found.keys() == wanted.keys()
    for name, version in found.items():
        assert version in wanted[name]
        assert f">={version}" in str(wanted[name])


def test_a_mujoco_takes_the_place_of_the_pinned_one():
    told = constraints(Combination("3.11", "pinned", "3.17.0"), PROJECT, PINS).splitlines()
    assert [line for line in told if line.startswith("mujoco==")] == ["mujoco==3.17.0"]
    assert set(told) - {"mujoco==3.17.0"} == {line for line in PINS.splitlines() if line[0] != "#"} - {
        line for line in PINS.splitlines() if line.startswith("mujoco==")
    }
    assert constraints(Combination("3.11", "newest"), PROJECT, PINS).strip() == ""
    assert "mujoco==3.5\n" in constraints(Combination("3.11", "oldest"), PROJECT, PINS)


def test_every_python_has_the_three_and_the_first_what_is_between():
    found = list(map(str, combinations(["3.11", "3.12"])))
    assert len(found) == len(set(found)) == 8
    assert found[:3] == ["3.11,oldest", "3.11,pinned", "3.11,newest"]
    assert found[-1] == "3.11,pinned,3.17.0"


def test_what_has_passed_is_not_run_again(tmp_path, monkeypatch):
    ran = []

    def measured(combination, quick):
        ran.append(str(combination))
        failed = combination.versions == "newest"
        return dict.fromkeys(matrix.COLUMNS, "1") | {
            "combination": str(combination),
            "tests": "quick" if quick else "whole",
            "reason": "FAILED a|b" if failed else "",
        }

    monkeypatch.setattr(matrix, "measure", measured)
    monkeypatch.setattr(matrix, "RESULTS", tmp_path)
    monkeypatch.setattr(matrix, "_answers", lambda name: name == "python3.12")
    monkeypatch.setattr(sys, "argv", ["matrix", "--quick", "--only", "3.12,oldest"])
    assert main() == 0 and ran == ["3.12,oldest"]
    monkeypatch.setattr(sys, "argv", ["matrix", "--quick"])
    assert main() == 1 and "3.12,oldest" not in ran[1:] and len(ran) == 5
    assert main() == 1 and ran[5:] == ["3.12,newest"]  # what failed is tried again
    monkeypatch.setattr(sys, "argv", ["matrix"])
    main()
    assert len(ran) == 6 + 5  # quick is not whole
    rows = list(csv.DictReader((tmp_path / "matrix.csv").open()))
    assert len(rows) == 5
    assert (tmp_path / "matrix.md").read_text() == table(rows)
    assert all(line.count("|") == 12 for line in table(rows).splitlines())


def test_a_python_that_only_complains_is_not_there(tmp_path, monkeypatch):
    for name, status in (("python3.97", 0), ("python3.98", 1)):
        (tmp_path / name).write_text(f"#!/bin/sh\nexit {status}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert [matrix._answers(f"python3.{minor}") for minor in (97, 98, 99)] == [True, False, False]


def test_the_tests_of_the_quick_part_exist():
    assert all((ROOT / path).exists() for path in matrix.QUICK)
