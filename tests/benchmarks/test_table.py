"""The table of returns: its experiments can be made, and its cells say what the rows say."""

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
    assert table.RESULTS.with_suffix(".md").read_text() == table.markdown(table.read_table())


def test_a_row_found_anew_takes_the_place_of_the_one_kept_and_the_others_stay_in_order():
    def of(env_id, arm, seed, condition, value):
        return row(arm, seed, condition, **{"return": value}) | {"task": env_id}

    kept = [
        of("SafeCarGoal1-v0", "filtered", "0", "training", 1),
        of("SafePointGoal1-v0", "filtered", "1", "filter_on", 2),
        of("SafePointGoal1-v0", "filtered", "0", "filter_on", 3),
    ]
    found = [
        of("SafeCarGoal1-v0", "filtered", 0, "training", 4),
        of("SafeCarGoal1-v0", "unfiltered", 0, "filter_off", 5),
    ]
    assert [float(row["return"]) for row in table.merged(kept, found)] == [3, 2, 5, 4]


def test_the_published_rows_are_in_order():
    rows = table.read_table()
    assert table.merged(rows, []) == rows and all(row["versions"] for row in rows)
