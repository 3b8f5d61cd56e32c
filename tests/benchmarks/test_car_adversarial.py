"""The car's adversarial table: a little of it, and more on demand (`make test-slow`)."""

import pytest

from benchmarks.adversarial import VARIANTS, Job, jobs, run, table
from benchmarks.car_drivers import DRIVERS

RECIPE = next(iter(VARIANTS["car"]))


def test_the_drivers_do_violate_without_the_filter():
    seeking = [d for d in DRIVERS if d.endswith("seeking")] + ["full throttle"]
    rows = [run(Job(2, d, 250, 3, filtered=False, variant=RECIPE, robot="car")) for d in seeking]
    assert all(row["violations"] > 0 for row in rows), rows


def test_a_row_of_the_table():
    row = run(Job(1, "full throttle", 250, 77, variant=RECIPE, robot="car"))
    assert row["violations"] == row["infeasible"] == 0 < row["intervened"]
    assert "| 1 | full throttle | detour | 250 | 0 |" in table([row | {"return_mean": 0.0}])


def test_the_steps_are_shared_out_among_the_drivers():
    class Arguments:
        robot, level, steps, parts, off, price, mismatch = "car", [1, 2], 700, 2, False, False, False

    made = jobs(Arguments)
    assert sum(job.steps for job in made) == 1400
    assert {(job.robot, job.variant, job.driver) for job in made} == {("car", RECIPE, d) for d in DRIVERS}
    assert len(set(made)) == len(made) == 2 * 2 * len(DRIVERS)


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("driver", DRIVERS)
def test_no_violation_in_twenty_episodes(level, driver):
    row = run(Job(level, driver, 20_000, 78, variant=RECIPE, robot="car"))
    assert row["violations"] == row["cost"] == row["infeasible"] == row["unsafe"] == 0
