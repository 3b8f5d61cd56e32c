import pytest
from made_up import episode, write_evaluation

from safe_wrappers.train.evaluation.episode_selection import compared_pairs, shown_episode


def evaluated(experiment, violations=(0, 0, 0), changed=(0.0, 0.0, 0.0)):
    write_evaluation(experiment, 0, 0, "filter_off", [episode(violations=count) for count in violations])
    write_evaluation(experiment, 1, 0, "filter_on", [episode(intervention_rate=rate) for rate in changed])
    return shown_episode(experiment)


@pytest.mark.parametrize(
    ("violations", "changed", "episode_seed", "reason"),
    [
        ((1, 9, 9), (0.9, 0, 0), 101, "with most violations of “unfiltered” with the filter off"),
        ((0, 0, 0), (0.1, 0.1, 0.5), 102, "in which the filter changed most steps of “filtered”"),
        ((0, 0, 0), (0, 0, 0), 100, "the first of the 3 evaluation episodes"),
    ],
)
def test_the_episode_that_shows_most(fake_experiment, violations, changed, episode_seed, reason):
    shown = evaluated(fake_experiment(), violations, changed)
    assert (shown.seed, shown.episode_seed) == (0, episode_seed)
    assert shown.reason.startswith(f"Episode seed {episode_seed}, policies of training seed 0: ")
    assert reason in shown.reason


def test_policies_of_several_tasks_are_shown_where_all_of_them_hurt_most(fake_experiment):
    experiment = fake_experiment(
        "arms={one: {filter: none}, two: {filter: none}}", "evaluation.filter={factory: 'fake_task:shield'}"
    )
    for arm, counts in ((0, (4, 3, 0)), (1, (0, 3, 4))):
        write_evaluation(experiment, arm, 0, "filter_off", [episode(violations=count) for count in counts])
    shown = shown_episode(experiment)
    assert shown.episode_seed == 101
    assert "with most violations of “one” and “two” together" in shown.reason


def test_before_any_evaluation_there_is_none(fake_experiment):
    assert shown_episode(fake_experiment()) is None


def names(experiment):
    return [(pair.bare.name, pair.filtered.name) for pair in compared_pairs(experiment)]


def test_the_headline_compares_arms_of_one_env(fake_experiment):
    assert names(fake_experiment()) == [("unfiltered", "filtered")]
    assert names(fake_experiment("arms.unfiltered.env=Pendulum-v1")) == [("filtered", "filtered")]
    bare = "arms={one: {filter: none}, two: {filter: none}}"
    assert names(fake_experiment(bare)) == []
    driven = fake_experiment(bare, "evaluation.filter={factory: 'fake_task:shield'}")
    assert names(driven) == [("one", "one"), ("two", "two")]
