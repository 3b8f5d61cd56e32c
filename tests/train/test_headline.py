"""The first sentences of the report must not say more than the numbers do."""

import pytest
from made_up import episode, fill, steps, write_evaluation

from safe_wrappers.train.report.headline import cards
from safe_wrappers.train.report.verdict import verdict
from safe_wrappers.train.summary import summarize

# Training: 10 episodes of 100 steps for each of 2 seeds; evaluation 2 episodes each: 2,400 steps a side.


def told(experiment, **more):
    fill(experiment, **more)
    return verdict(experiment, summarize(experiment))


@pytest.mark.parametrize(
    ("off", "on", "sentence"),
    [
        (
            {"violations": 5, "return": 20},
            {"return": 10},
            "With the filter none of 2,400 steps was in violation; without it 120 of 2,400 steps (5 %) were."
            " The return per episode was 50 % lower (from 20 to 10; the intervals over 2 seeds lie apart).",
        ),
        (
            {"violations": 5, "return": -20},
            {"violations": 1, "return": -10},
            "The filter lowered violations without removing them: 24 of 2,400 steps (1 %) with it,"
            " 120 of 2,400 steps (5 %) without. The return per episode went from -20 to -10"
            " (the intervals over 2 seeds lie apart).",
        ),
        (
            {"violations": 1, "return": 10},
            {"violations": 1, "return": 10},
            "The filter did not lower violations: 24 of 2,400 steps (1 %) with it, 24 of 2,400 steps (1 %)"
            " without. The return per episode stayed the same (from 10 to 10; the intervals over 2 seeds overlap).",
        ),
        (
            {"return": 10},
            {"return": 12},
            "No violation with the filter, and none without it: the task did not put it to the test."
            " The return per episode was 20 % higher",
        ),
        (
            {"violations": 1},
            {"intervention_rate": 0.25, "infeasible": 2, "fallback": 3},
            "It changed 25 % of the evaluation steps; 48 steps were infeasible and 72 ran the fallback.",
        ),
        (
            {"violations": 1},
            {"intervention_rate": 0.00001},
            "It changed less than 0.01 % of the evaluation steps; no step was infeasible and none ran the"
            " fallback.",
        ),
        (
            {"violations": 5, "collisions": 2, "return": 10},
            {"return": 10},
            "without it 120 of 2,400 steps (5 %) were. Collisions begun: 0 with it, 48 without. The return",
        ),
        ({"violations": 1}, {}, "It changed none of the evaluation steps; no step was infeasible"),
    ],
)
def test_verdicts(fake_experiment, off, on, sentence):
    assert sentence in told(fake_experiment(), off=off, on=on)


def test_one_seed_says_little(fake_experiment):
    said = told(fake_experiment("seeds=[0]"), off={"return": 20}, on={"return": 10})
    assert "50 % lower (from 20 to 10; one seed says little)" in said


def test_a_task_without_a_cost_has_no_violations_to_count(fake_experiment):
    experiment = fake_experiment()
    silent = steps(cost=steps().cost * float("nan"))
    said = told(experiment, off={}, on={"unsafe": 3}, log_off=silent, log_on=silent)
    assert said.startswith(
        "The task reports no cost, so violations cannot be counted; by the filter's own measure 72 of 2,400 steps"
        " with it began outside the safe set."
    )
    assert "in violation" not in said
    assert "Steps in violation" not in cards(experiment, summarize(experiment))


def test_without_an_arm_that_has_none_the_filter_is_switched_off(fake_experiment):
    shield = "{factory: 'fake_task:shield'}"
    experiment = fake_experiment(f"arms={{a: {{filter: {shield}}}, b: {{filter: {shield}}}}}")
    said = told(experiment, off={"violations": 5}, on={})
    # The evaluation only: both sides trained with it. 2 episodes of 100 steps for 2 seeds.
    assert "none of 400 steps was in violation; without it 20 of 400 steps (5 %) were" in said
    page = cards(experiment, summarize(experiment))
    assert "The same policies, “a”, with the filter on and off." in page
    assert "with the filter, of 400 of evaluation" in page


def test_an_arm_of_another_env_is_not_compared_with(fake_experiment):
    experiment = fake_experiment(
        "arms.unfiltered.env=fake_task:FilmedGoal-v0", "arms.third={filter: none}", "seeds=[0]"
    )
    fill(experiment, off={"violations": 5}, on={})
    assert "Without: “third”" not in cards(experiment, summarize(experiment))  # nothing of it is there yet
    assert verdict(experiment, summarize(experiment)).startswith("There is no filter to compare with yet.")


def test_policies_of_several_tasks_driven_through_the_evaluations_filter(fake_experiment):
    experiment = fake_experiment(
        "arms={one: {filter: none}, two: {filter: none, env: Pendulum-v1}}",
        "evaluation.filter={factory: 'fake_task:shield'}",
    )
    fill(
        experiment,
        off={"violations": 5, "return": 20},
        on={"return": 10, "intervention_rate": 0.5},
        log_on=steps(),
    )
    # The evaluation of both arms: 2 episodes of 100 steps for 2 seeds each.
    assert verdict(experiment, summarize(experiment)) == (
        "With the filter none of 800 steps was in violation; without it 40 of 800 steps (5 %) were."
        " The return per episode went: one 20 to 10, two 20 to 10."
        " It changed 50 % of the evaluation steps; no step was infeasible and none ran the fallback."
    )
    page = cards(experiment, summarize(experiment))
    assert "The same policies, “one”, “two”, with the filter on and off." in page
    assert "Return per episode" not in page  # of two tasks there is no common one
    assert "50 µs" in page


def test_the_filters_time_is_the_evaluations_where_no_training_had_it(fake_experiment):
    experiment = fake_experiment(
        "arms={one: {filter: none}}", "evaluation.filter={factory: 'fake_task:shield'}"
    )
    for seed in experiment.seeds:
        write_evaluation(experiment, 0, seed, "filter_off", [episode()])
        write_evaluation(experiment, 0, seed, "filter_on", [episode()], steps())
    assert "70 µs" in cards(experiment, summarize(experiment))


def test_without_any_filter_there_is_nothing_to_compare(fake_experiment):
    experiment = fake_experiment("arms={one: {filter: none}, two: {filter: none}}")
    said = told(experiment, off={"violations": 5, "return": 3}, on={})
    assert "one: return 3 in evaluation, 20 of 400 steps in violation." in said
    assert cards(experiment, summarize(experiment)) == ""


def test_the_cards(fake_experiment):
    experiment = fake_experiment()
    fill(
        experiment,
        off={"violations": 5, "return": 20},
        on={"return": 10, "intervention_rate": 0.125, "infeasible": 1, "fallback": 2},
    )
    page = cards(experiment, summarize(experiment))
    for expected in (
        '<h3>Steps in violation</h3><p class="value good">0</p>',
        "with the filter, of 2,400 of training and evaluation",
        "without: 120 of 2,400",
        '<h3>Return per episode</h3><p class="value ">10</p>',
        "without: 20",
        '<h3>Steps changed</h3><p class="value ">12 %</p>',
        '<h3>Infeasible steps</h3><p class="value ">24</p>',
        "fallback: 48 steps",
        '<h3>Filter time per step</h3><p class="value ">50 µs</p>',
        "With the filter: “filtered”, trained and evaluated through it.",
    ):
        assert expected in page
