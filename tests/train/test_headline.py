"""The first sentences of the report must not say more than the numbers do."""

import pytest
from made_up import SILENT, episode, fill, write_evaluation

from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.report import verdict

# Training: 10 episodes of 100 steps for each of 2 seeds; evaluation 2 episodes each: 2,400 steps a side.


def told(experiment, **more):
    fill(experiment, **more)
    return " ".join(verdict(experiment, summarize(experiment)))


@pytest.mark.parametrize(
    ("off", "on", "sentence"),
    [
        (
            {"violations": 5, "return": 20},
            {"return": 10},
            "With the filter none of 2,400 steps was in violation; without it 120 of 2,400 steps (5 %) were."
            " Return per evaluation episode: Trained without the filter, filter off 20 [20, 20] with 20 of 400",
        ),
        (
            {"violations": 5, "return": -20},
            {"violations": 1, "return": -10},
            "The filter lowered violations without removing them: 24 of 2,400 steps (1 %) with it,"
            " 120 of 2,400 steps (5 %) without. Return per evaluation episode: Trained without the filter,"
            " filter off -20 [-20, -20] with 20 of",
        ),
        (
            {"violations": 1, "return": 10},
            {"violations": 1, "return": 10},
            "The filter did not lower violations: 24 of 2,400 steps (1 %) with it, 24 of 2,400 steps (1 %)"
            " without. Return per evaluation episode: Trained without the filter, filter off 10",
        ),
        (
            {"return": 10},
            {"return": 12},
            "No violation with the filter, and none without it: the task did not put it to the test."
            " Return per evaluation episode: Trained without the filter, filter off 10 [10, 10] with 0",
        ),
        (
            {"violations": 1},
            {"intervention_rate": 0.25, "infeasible": 2, "fallback": 3},
            "The filter changed 25 % of the evaluation steps. Of 2,400 steps with it 48 steps were infeasible and"
            " 72 ran the fallback.",
        ),
        (
            {"violations": 1},
            {"intervention_rate": 0.00001},
            "The filter changed less than 0.01 % of the evaluation steps. Of 2,400 steps with it 0 steps were",
        ),
    ],
)
def test_verdicts(fake_experiment, off, on, sentence):
    assert sentence in told(fake_experiment(), off=off, on=on)


def four_ways(experiment, spread=0.0):
    """Either policy in evaluation without and with the filter: 21.1, 12.7; 9.4, 5.03 in the mean of the seeds."""
    for seed in experiment.seeds:
        off = spread * (seed - (len(experiment.seeds) - 1) / 2)
        for arm, condition, returns, violations in (
            (0, "filter_off", 21.1, 5),
            (0, "filter_on", 12.7, 0),
            (1, "filter_off", 9.4, 3),
            (1, "filter_on", 5.03, 0),
        ):
            row = episode(**{"return": returns + off, "violations": violations})
            write_evaluation(experiment, arm, seed, condition, [row])
    return summarize(experiment)


def test_the_verdict_names_what_either_policy_returns_without_and_with_the_filter(fake_experiment):
    experiment = fake_experiment()
    numbers = four_ways(experiment, spread=1.0)
    assert verdict(experiment, numbers)[:3] == [
        "With the filter none of 200 steps was in violation; without it 10 of 200 steps (5 %) were.",
        "Return per evaluation episode: Trained without the filter, filter off 21.1 [20.6, 21.6] with 10 of 200"
        " steps in violation; Trained without the filter, filter on 12.7 [12.2, 13.2] with 0 of 200 steps in"
        " violation; Trained through the filter, filter off 9.4 [8.9, 9.9] with 6 of 200 steps in violation;"
        " Trained through the filter, filter on 5.03 [4.53, 5.53] with 0 of 200 steps in violation.",
        "With the filter on, the policy trained without it returned more (2 seeds say little).",
    ]


@pytest.mark.parametrize(
    ("seeds", "spread", "surely"),
    [
        ("[0]", 0.0, "one seed says little"),
        ("[0, 1]", 0.1, "2 seeds say little"),
        ("[0, 1, 2]", 0.1, "the intervals over 3 seeds lie apart"),
        ("[0, 1, 2]", 9.0, "the intervals over 3 seeds overlap"),
    ],
)
def test_fewer_than_three_seeds_have_no_interval(fake_experiment, seeds, spread, surely):
    experiment = fake_experiment(f"seeds={seeds}")
    said = " ".join(verdict(experiment, four_ways(experiment, spread)))
    assert f"trained without it returned more ({surely})." in said
    if len(experiment.seeds) < 3:
        assert "lie apart" not in said and "overlap" not in said and "95 %" not in said


def test_a_task_without_a_cost_has_no_violations_to_count(fake_experiment):
    experiment = fake_experiment()
    said = told(experiment, off=SILENT, on=SILENT | {"unsafe": 3})
    assert said.startswith("Violations are not judged: the task reports no cost.")
    assert "By the filter's own measure 72 of 2,400 steps with it began outside the safe set." in said
    assert "in violation" not in said


def test_without_an_arm_that_has_none_the_filter_is_switched_off(fake_experiment):
    shield = "{factory: 'fake_task:shield'}"
    experiment = fake_experiment(f"arms={{a: {{filter: {shield}}}, b: {{filter: {shield}}}}}")
    said = told(experiment, off={"violations": 5}, on={})
    # The evaluation only: both sides trained with it. 2 episodes of 100 steps for 2 seeds.
    assert "none of 400 steps was in violation; without it 20 of 400 steps (5 %) were" in said


def test_policies_of_several_tasks_driven_through_the_evaluations_filter(fake_experiment):
    experiment = fake_experiment(
        "arms={one: {filter: none}, two: {filter: none, env: Pendulum-v1}}",
        "evaluation.filter={factory: 'fake_task:shield'}",
    )
    fill(
        experiment,
        off={"violations": 5, "return": 20},
        on={"return": 10, "intervention_rate": 0.5},
    )
    # The evaluation of both arms: 2 episodes of 100 steps for 2 seeds each.
    assert " ".join(verdict(experiment, summarize(experiment))) == (
        "With the filter none of 800 steps was in violation; without it 40 of 800 steps (5 %) were."
        " The filter changed 50 % of the evaluation steps. Of 800 steps with it 0 steps were infeasible and 0 ran the"
        " fallback."
    )
