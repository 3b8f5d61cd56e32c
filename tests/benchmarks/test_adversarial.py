"""The adversarial table of docs/results/goal-tasks.md, shorter: minutes long, so `make test-slow` runs it."""

import pytest

from benchmarks.adversarial import Job, run
from benchmarks.drivers import DRIVERS


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("driver", DRIVERS)
def test_no_violation_in_fifty_episodes(level, driver):
    row = run(Job(level, driver, steps=50_000, seed=77))
    assert row["violations"] == row["cost"] == row["infeasible"] == row["unsafe"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.8, 1.2])
@pytest.mark.parametrize("damping", [0.8, 1.2])
def test_no_violation_with_a_wrong_plant(mass, damping):
    row = run(Job(1, "lateral-drift", 20_000, 78, mass=mass, damping=damping, uncertainty=0.25))
    assert row["violations"] == 0


def test_the_drivers_do_violate_without_the_filter():
    assert run(Job(1, "hazard-seeking", 1500, 77, filtered=False))["violations"] > 20
