import pytest
from made_up import episode, write_evaluation

from safe_wrappers.train.evaluation.evaluate import compared_pairs, shown_episode


@pytest.mark.parametrize(
    ("returns", "typical"),
    [
        ((1.0, 9.0, 5.0), 102),
        ((4.0, 3.0, 1.0, 2.0), 103),
        ((2.0, 2.0), 100),
        ((7.0,), 100),
    ],
)
def test_a_typical_episode_is_shown(fake_experiment, returns, typical):
    experiment = fake_experiment()
    write_evaluation(experiment, 1, 0, "filter_on", [{**episode(), "return": value} for value in returns])
    shown = shown_episode(experiment)
    assert (shown.seed, shown.episode_seed) == (0, typical)
    assert shown.reason.startswith(f"Episode seed {typical}, policies of training seed 0: ")
    assert "the median return of “filtered” with the filter on" in shown.reason


def test_where_nothing_is_filtered_it_is_the_first_arms(fake_experiment):
    experiment = fake_experiment("arms={one: {filter: none}, two: {filter: none}}")
    write_evaluation(
        experiment, 0, 0, "filter_off", [{**episode(), "return": value} for value in (3.0, 1.0, 2.0)]
    )
    assert shown_episode(experiment).episode_seed == 102


def names(experiment):
    return [(pair.bare.name, pair.filtered.name) for pair in compared_pairs(experiment)]


def test_the_headline_compares_arms_of_one_env(fake_experiment):
    assert names(fake_experiment()) == [("unfiltered", "filtered")]
    assert names(fake_experiment("arms.unfiltered.env=Pendulum-v1")) == [("filtered", "filtered")]
    bare = "arms={one: {filter: none}, two: {filter: none}}"
    assert names(fake_experiment(bare)) == []
    driven = fake_experiment(bare, "evaluation.filter={factory: 'fake_task:shield'}")
    assert names(driven) == [("one", "one"), ("two", "two")]
