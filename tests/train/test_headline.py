"""The first sentences of the report must not say more than the numbers do."""

import pytest
from made_up import SILENT, episode, fill, write_evaluation, write_training

from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.report.verdict import cards, verdict

# Training: 10 episodes of 100 steps for each of 2 seeds; evaluation 2 episodes each: 2,400 steps a side.


def shown(experiment, filter_us=None):
    """The cards, a line each."""
    found = cards(experiment, summarize(experiment), filter_us)
    return [" | ".join([card.title, card.value, *card.lines, card.mood]) for card in found]


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
            " Trained without the filter, the policy returned",
        ),
        (
            {"violations": 5, "return": -20},
            {"violations": 1, "return": -10},
            "The filter lowered violations without removing them: 24 of 2,400 steps (1 %) with it,"
            " 120 of 2,400 steps (5 %) without. Trained without the filter, the policy returned per evaluation"
            " episode -20 [-20, -20] without",
        ),
        (
            {"violations": 1, "return": 10},
            {"violations": 1, "return": 10},
            "The filter did not lower violations: 24 of 2,400 steps (1 %) with it, 24 of 2,400 steps (1 %)"
            " without. Trained without the filter, the policy returned per evaluation"
            " episode 10",
        ),
        (
            {"return": 10},
            {"return": 12},
            "No violation with the filter, and none without it: the task did not put it to the test."
            " Trained without the filter, the policy returned per evaluation episode 10 [10, 10] without it (no",
        ),
        (
            {"violations": 1},
            {"intervention_rate": 0.25, "infeasible": 2, "fallback": 3},
            "The filter changed 25 % of the evaluation steps; 8 steps were infeasible and 12 ran the fallback."
            " In training 40 steps were infeasible and 60 ran the fallback, of 2,000.",
        ),
        (
            {"violations": 1},
            {"intervention_rate": 0.00001},
            "The filter changed less than 0.01 % of the evaluation steps; no step was infeasible and none ran the"
            " fallback.",
        ),
        (
            {"violations": 5, "collisions": 2, "return": 10},
            {"return": 10},
            "without it 120 of 2,400 steps (5 %) were. Collisions begun: 0 with it, 48 without. Trained",
        ),
        ({"violations": 1}, {}, "The filter changed none of the evaluation steps; no step was infeasible"),
    ],
)
def test_verdicts(fake_experiment, off, on, sentence):
    assert sentence in told(fake_experiment(), off=off, on=on)


def test_what_was_infeasible_in_training_alone_is_not_told_of_the_evaluation(fake_experiment):
    experiment = fake_experiment()
    fill(experiment, {"violations": 1}, {"intervention_rate": 0.5})
    write_training(experiment, 1, 0, [{"timesteps": 100, **episode(infeasible=1)}])
    said = " ".join(verdict(experiment, summarize(experiment)))
    assert (
        "of the evaluation steps; no step was infeasible and none ran the fallback. In training 1 step was"
        in said
    )
    nothing = "where no action was admissible, of training and evaluation"
    assert f"Infeasible steps | 1 | {nothing} | fallback: 0 steps | " in shown(experiment)


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
    assert verdict(experiment, numbers)[:4] == [
        "With the filter none of 200 steps was in violation; without it 10 of 200 steps (5 %) were.",
        "Trained without the filter, the policy returned per evaluation episode 21.1 [20.6, 21.6] without it (10 of"
        " 200 steps in violation, 5 %) and 12.7 [12.2, 13.2] with it added afterwards (no step in violation).",
        "Trained through the filter, the policy returned per evaluation episode 9.4 [8.9, 9.9] with it taken off"
        " (6 of 200 steps in violation, 3 %) and 5.03 [4.53, 5.53] with it (no step in violation).",
        "With the filter on, the policy trained without it returned more (2 seeds say little)."
        " In brackets the range over 2 seeds, which is not an interval. Trained for 512 control steps each.",
    ]
    assert shown(experiment)[:4] == [
        "Trained without the filter, filter off | 21.1 | return per episode | range 20.6 to 21.6"
        " | 10 of 200 steps in violation | ",
        "Trained without the filter, filter on | 12.7 | return per episode | range 12.2 to 13.2"
        " | no step in violation | ",
        "Trained through the filter, filter off | 9.4 | return per episode | range 8.9 to 9.9"
        " | 6 of 200 steps in violation | ",
        "Trained through the filter, filter on | 5.03 | return per episode | range 4.53 to 5.53"
        " | no step in violation | ",
    ]


@pytest.mark.parametrize(
    ("seeds", "spread", "surely", "brackets"),
    [
        ("[0]", 0.0, "one seed says little", "One seed: no interval."),
        (
            "[0, 1]",
            0.1,
            "2 seeds say little",
            "In brackets the range over 2 seeds, which is not an interval.",
        ),
        (
            "[0, 1, 2]",
            0.1,
            "the intervals over 3 seeds lie apart",
            "In brackets bootstrap 95 % intervals over seeds.",
        ),
        (
            "[0, 1, 2]",
            9.0,
            "the intervals over 3 seeds overlap",
            "In brackets bootstrap 95 % intervals over seeds.",
        ),
    ],
)
def test_fewer_than_three_seeds_have_no_interval(fake_experiment, seeds, spread, surely, brackets):
    experiment = fake_experiment(f"seeds={seeds}")
    said = " ".join(verdict(experiment, four_ways(experiment, spread)))
    assert f"trained without it returned more ({surely}). {brackets}" in said
    if len(experiment.seeds) < 3:
        assert "lie apart" not in said and "overlap" not in said and "95 %" not in said


def test_more_return_through_training_with_the_filter_is_said_too(fake_experiment):
    experiment = fake_experiment("seeds=[0]")
    write_evaluation(experiment, 0, 0, "filter_on", [episode(**{"return": 1})])
    write_evaluation(experiment, 0, 0, "filter_off", [episode(**{"return": 3})])
    write_evaluation(experiment, 1, 0, "filter_on", [episode(**{"return": 2})])
    said = " ".join(verdict(experiment, summarize(experiment)))
    assert "the policy trained through it returned more" in said
    # What has not been evaluated is not told.
    assert "Trained through the filter, the policy returned per evaluation episode 2 with it (no step" in said


def test_a_task_without_a_cost_has_no_violations_to_count(fake_experiment):
    experiment = fake_experiment()
    said = told(experiment, off=SILENT, on=SILENT | {"unsafe": 3})
    assert said.startswith("Violations are not judged: the task reports no cost.")
    assert "By the filter's own measure 72 of 2,400 steps with it began outside the safe set." in said
    assert "in violation" not in said
    assert (
        "in violation" not in str(shown(experiment))
        and str(shown(experiment)).count("violations not judged") == 4
    )


def test_without_an_arm_that_has_none_the_filter_is_switched_off(fake_experiment):
    shield = "{factory: 'fake_task:shield'}"
    experiment = fake_experiment(f"arms={{a: {{filter: {shield}}}, b: {{filter: {shield}}}}}")
    said = told(experiment, off={"violations": 5}, on={})
    # The evaluation only: both sides trained with it. 2 episodes of 100 steps for 2 seeds.
    assert "none of 400 steps was in violation; without it 20 of 400 steps (5 %) were" in said
    assert "with the filter, of 400 of evaluation" in str(shown(experiment))


def test_an_arm_of_another_env_is_not_compared_with(fake_experiment):
    experiment = fake_experiment(
        "arms.unfiltered.env=fake_task:FilmedGoal-v0", "arms.third={filter: none}", "seeds=[0]"
    )
    fill(experiment, off={"violations": 5}, on={})
    assert verdict(experiment, summarize(experiment))[0].startswith("There is no filter to compare with yet.")


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
        " The return per episode went: one 20 to 10, two 20 to 10."
        " The filter changed 50 % of the evaluation steps; no step was infeasible and none ran the fallback."
    )
    assert "return per episode" not in str(shown(experiment))  # of two tasks there is no common one


def test_without_any_filter_there_is_nothing_to_compare(fake_experiment):
    experiment = fake_experiment("arms={one: {filter: none}, two: {filter: none}}")
    said = told(experiment, off={"violations": 5, "return": 3}, on={})
    assert "one: return 3 in evaluation, 20 of 400 steps in violation." in said
    assert shown(experiment) == []


def test_the_cards(fake_experiment):
    experiment = fake_experiment()
    fill(
        experiment,
        off={"violations": 5, "return": 20},
        on={"return": 10, "intervention_rate": 0.125, "infeasible": 1, "fallback": 2},
    )
    assert shown(experiment, 50.0) == [
        "Trained without the filter, filter off | 20 | return per episode | range 20 to 20"
        " | 20 of 400 steps in violation | ",
        "Trained without the filter, filter on | 10 | return per episode | range 10 to 10 | no step in violation | ",
        "Trained through the filter, filter off | 20 | return per episode | range 20 to 20"
        " | 20 of 400 steps in violation | ",
        "Trained through the filter, filter on | 10 | return per episode | range 10 to 10 | no step in violation | ",
        "Steps in violation | 0 | with the filter, of 2,400 of training and evaluation"
        " | without: 120 of 2,400 | good",
        "Steps changed | 12 % | by the filter, in evaluation | ",
        "Infeasible steps | 24 | where no action was admissible, of training and evaluation"
        " | fallback: 48 steps | ",
        "Filter time per step | 50 µs | mean, on the machine that ran it | ",
    ]
