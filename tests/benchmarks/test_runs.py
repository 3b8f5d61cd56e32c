"""The runner and the scripts: each is found by its name, and a small part of it counts what it should."""

import ast
import importlib
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import adversarial, impact, leases, mutants, occlusion, slip, tables, teleop
from benchmarks.__main__ import names


@pytest.mark.parametrize("name", names())
def test_every_script_is_found_and_says_in_a_line_what_it_does(name):
    if "train" in name or name in ("table", "endurance", "moving_picture"):
        pytest.importorskip("stable_baselines3")
    if name == "bench":
        pytest.importorskip("qpsolvers")
    assert callable(importlib.import_module(f"benchmarks.{name}").main)
    assert names()[name].endswith(".") or names()[name].endswith("?")


def test_what_is_no_name_is_an_error():
    done = subprocess.run([sys.executable, "-m", "benchmarks", "no_such"], capture_output=True, text=True)
    assert done.returncode == 1 and "golden_traces" in done.stdout


@pytest.mark.parametrize("robot", ["point", "car"])
def test_violations_are_the_tasks_own_and_none_with_the_filter(robot):
    rows = [
        adversarial.run(adversarial.Job(1, "hazard-seeking", 400, 3, filtered=on, robot=robot))
        for on in (False, True)
    ]
    assert rows[0]["violations"] > 0 == rows[1]["violations"]
    assert "| hazard-seeking | on | 400 | 0 |" in adversarial.table(rows)


def test_a_rover_slips_less_with_the_limiter():
    off, on = (slip.run(slip.Job("full throttle", limited, 300, 0)) for limited in (False, True))
    assert off["slipping"] > 250 and on["slipping"] < 10


def test_a_crossing_without_a_filter_collides():
    rows = [occlusion.run(occlusion.Job("pulse", arm, 500, 1)) for arm in ("no filter", "true state")]
    assert rows[0]["collisions"] > 0 == rows[1]["collisions"]


@pytest.mark.parametrize("seed", range(3))
def test_a_lease_of_the_formula_just_holds_and_one_that_is_longer_does_not(seed):
    assert 0.0 < leases.worst_case(1.0, (1, seed))["lowest"] < 1e-4
    assert leases.worst_case(1.05, (1, seed))["contact"]


def test_approaches_above_the_force_limit_are_counted(monkeypatch):
    monkeypatch.setattr(impact, "BLOCK", 8)
    off, on = (impact.run(impact.Job(limited, 0)) for limited in (False, True))
    assert off["exceeded"] > 0 == on["exceeded"]


def test_a_plain_channel_makes_energy():
    jobs = [teleop.Job(coding, "steady", 0.1, "careful", False, 0, 3000) for coding in ("plain", "wave")]
    plain, wave = (teleop.run(job)["made_j"] for job in jobs)
    assert plain > 1.0 and wave < 1e-9


def test_a_stopped_measurement_goes_on(tmp_path):
    path, ran = tmp_path / "rows.jsonl", []

    def run(job):
        ran.append(job.block)
        return {"mode": job.mode, "block": job.block, "found": 1.0}

    jobs = [leases.Job("lease", block) for block in range(3)]
    tables.measured(path, jobs[:2], run, 1)
    path.write_text(path.read_text() + '{"mode": "lea')  # a row that was cut
    assert [row["block"] for row in tables.measured(path, jobs, run, 1)] == [0, 1, 2] == ran


SOURCE = """
def f(a, b: int = 1):
    'Of a and b.'
    c = a + 2
    if a < b:
        return min(a, c)
    c = b
    return c
"""


def test_mutants_are_one_mistake_each_and_leave_words_and_types_alone():
    found = list(mutants.mistakes(ast.parse(SOURCE)))
    kinds = {kind for _, kind, _ in found}
    assert kinds == {"comparison", "arithmetic", "constant", "not", "min/max", "statement"}
    texts = set()
    for number in range(len(found)):
        tree = ast.parse(SOURCE)
        list(mutants.mistakes(tree))[number][2]()
        texts.add(ast.unparse(ast.fix_missing_locations(tree)))
    assert len(texts) == len(found) and ast.unparse(ast.parse(SOURCE)) not in texts
    assert all("'Of a and b.'" in text or '"""Of a and b."""' in text for text in texts)
    assert mutants.mistaken(SOURCE, mutants.Mutant("", "g", "not")) is None


def test_bench_pairs_are_in_turn():
    taken = tables.paired_us({"a": lambda: np.zeros(1), "b": lambda: np.zeros(100_000)}, batch=2, rounds=3)
    assert taken["a"] < taken["b"]
