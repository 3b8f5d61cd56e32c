"""The table of returns: its experiments can be made, and its cells say what the rows say."""

import csv

import pytest

from benchmarks import table

BARE = dict.fromkeys(table.COLUMNS, "")


def row(arm, seed, condition, **values):
    about = {"task": "T-v0", "control_steps": "400", "action_repeat": "4", "arm": arm, "seed": seed}
    about["condition"] = condition
    return BARE | about | {"steps": "1000", "violations": "0"} | {k: str(v) for k, v in values.items()}


@pytest.mark.parametrize("task", table.TASKS, ids=lambda task: task.name)
def test_every_experiment_is_valid_and_its_own(task):
    experiment = table.experiment_of(task, "runs")
    assert experiment.name == task.name and len(experiment.seeds) == task.seeds
    assert {arm.env.id for arm in experiment.arms} == {task.env_id}
    assert len({other.name for other in table.TASKS}) == len(table.TASKS)


def test_cells_are_sums_of_violations_means_of_returns_and_shares_of_steps():
    rows = [
        row("filtered", 0, "training", violations=3),
        row("filtered", 1, "training", violations=4),
        row("filtered", 0, "filter_off", **{"return": 20, "cost": 5}),
        row("filtered", 1, "filter_off", **{"return": 22, "cost": 7}),
        row("filtered", 0, "filter_on", **{"return": 10, "cost": 0, "stuck": 10, "infeasible": 0}),
        row("filtered", 1, "filter_on", **{"return": 14, "cost": 0, "stuck": 0, "infeasible": 0}),
    ]
    line = table.markdown(rows).splitlines()[2]
    assert line == (
        "| T | 400 x 2 | 4 | filtered | 7 | 21 [20, 22]; 6 [5, 7] | 12 [10, 14]; 0 [0, 0] | 0.5 % | 0 % |"
    )


def test_what_was_not_counted_is_a_dash():
    rows = [
        row("unfiltered", 0, "training", violations=3),
        row("unfiltered", 0, "filter_off", **{"return": 20, "cost": 5}),
        row("unfiltered", 0, "filter_on", **{"return": 10, "cost": 0, "infeasible": 1}),
    ]
    assert (
        table.markdown(rows).splitlines()[2]
        == "| T | 400 x 1 | 4 | unfiltered | 3 | 20; 5 | 10; 0 | - | 0.1 % |"
    )


def test_the_shown_table_is_made_of_the_rows_beside_it():
    with table.RESULTS.open() as file:
        made = table.markdown(list(csv.DictReader(file)))
    shown = table.RESULTS.with_suffix(".md").read_text()
    assert shown.splitlines()[:-1] == made.splitlines()[:-1]  # the last line names versions
