import csv
import json

import numpy as np
import pytest

from safe_wrappers.train.evaluation.evaluate import EVALUATION_COLUMNS
from safe_wrappers.train.evaluation.summary import (
    Estimate,
    estimate,
    interquartile_mean,
    learning_curve,
    summarize,
    write_summary,
)
from safe_wrappers.train.files import write_rows
from safe_wrappers.train.run.training import EPISODE_COLUMNS


def episode(**values):
    row = dict.fromkeys(EPISODE_COLUMNS[2:], 0.0) | {"length": 10}
    return row | values


def write_training(experiment, arm, seed, rows):
    folder = experiment.run_folder(experiment.arms[arm], seed)
    write_rows(folder / "episodes.csv", EPISODE_COLUMNS, [{"env": 0, **row} for row in rows])


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([3.0], 3.0),
        ([1.0, 5.0], 3.0),
        ([0.0, 1.0, 8.0], 3.0),  # too few to cut: the plain mean
        ([-100.0, 1.0, 3.0, 100.0], 2.0),
        ([-100.0, 1.0, 2.0, 6.0, 100.0], 3.0),
        ([0.0] * 2 + [4.0] * 4 + [99.0] * 2, 4.0),
    ],
)
def test_interquartile_mean(values, expected):
    assert interquartile_mean(values) == pytest.approx(expected)
    assert interquartile_mean(np.array([values, values]), axis=1) == pytest.approx([expected] * 2)


def test_one_seed_has_no_interval():
    assert estimate([3.0]) == Estimate(3.0, None, None, 1)
    assert str(estimate([3.0])) == "3 [n/a]"


def test_intervals():
    assert estimate([0.0, 0.0, 0.0]) == Estimate(0.0, 0.0, 0.0, 3)
    two = estimate([1.0, 2.0])
    assert (two.iqm, two.low, two.high) == (1.5, 1.0, 2.0)
    five = estimate([1.0, 2.0, 3.0, 4.0, 5.0])
    assert five.iqm == 3.0
    assert 1.0 <= five.low < 3.0 < five.high <= 5.0
    assert five == estimate([1.0, 2.0, 3.0, 4.0, 5.0])  # not another interval at each look
    assert str(two) == "1.5 [1, 2]"


def test_the_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = [i.low <= 0 <= i.high for i in (estimate(list(rng.normal(size=20))) for _ in range(60))]
    assert 0.82 <= np.mean(hits) <= 1.0


def test_summary_of_rows(fake_experiment):
    experiment = fake_experiment()
    for seed, cost in ((0, 2.0), (1, 4.0)):
        rows = [episode(cost=cost, violations=3, timesteps=10), episode(cost=0, violations=1, timesteps=20)]
        write_training(experiment, 0, seed, rows)
        write_training(experiment, 1, seed, [episode(intervention_rate=0.5, timesteps=10)])
    folder = experiment.run_folder(experiment.arms[0], 0) / "evaluation"
    write_rows(
        folder / "filter_on.csv", EVALUATION_COLUMNS, [{"episode_seed": 100, **episode(**{"return": 7})}]
    )
    summary = summarize(experiment)
    bare, filtered = summary.table["unfiltered"], summary.table["filtered"]
    assert bare["training"]["cost"] == Estimate(1.5, 1.0, 2.0, 2)  # mean over episodes, then over seeds
    assert bare["training"]["violations"].iqm == 4.0  # a total
    assert bare["training"]["violations_per_1000"].iqm == 1000.0 * 4 / 20  # over all steps, not over episodes
    assert "intervention_rate" not in bare["training"]  # no filter was on
    assert "infeasible_per_1000" not in bare["training"]
    assert filtered["training"]["infeasible_per_1000"].iqm == 0.0
    assert filtered["training"]["intervention_rate"].iqm == 0.5
    assert bare["filter_on"]["return"] == Estimate(7.0, None, None, 1)
    assert filtered["filter_on"] == bare["filter_off"] == {}

    write_summary(summary, experiment.folder)
    with (experiment.folder / "per_seed.csv").open() as file:
        per_seed = list(csv.DictReader(file))
    assert [(row["arm"], row["seed"], row["condition"]) for row in per_seed] == [
        ("unfiltered", "0", "training"),
        ("unfiltered", "1", "training"),
        ("unfiltered", "0", "filter_on"),
        ("filtered", "0", "training"),
        ("filtered", "1", "training"),
    ]
    assert (per_seed[1]["cost"], per_seed[1]["steps"], per_seed[1]["episodes"]) == ("2.0", "20", "2")
    saved = json.loads((experiment.folder / "summary.json").read_text())
    assert saved["unfiltered"]["training"]["cost"] == {
        "iqm": 1.5,
        "low": 1.0,
        "high": 2.0,
        "seeds": 2,
        "spread": "range",
    }


def test_learning_curve(fake_experiment):
    experiment = fake_experiment()
    for seed in (0, 1):
        rows = [episode(timesteps=10 * t, cost=t + 2 * seed) for t in range(1, 101)]
        write_training(experiment, 0, seed, rows)
    curve = learning_curve(experiment, experiment.arms[0], "cost")
    assert len(curve.steps) == 40
    assert curve.iqm[0] == pytest.approx(1.5 + 1)  # episodes 1 and 2 of either seed
    assert np.all(np.diff(curve.iqm) > 0)
    assert curve.low[-1] == pytest.approx(curve.iqm[-1] - 1)
    assert curve.high[-1] == pytest.approx(curve.iqm[-1] + 1)
    # Fewer bins where a seed has few episodes; none at all where a seed has none.
    write_training(experiment, 0, 1, [episode(timesteps=500, cost=1), episode(timesteps=1000, cost=3)])
    curve = learning_curve(experiment, experiment.arms[0], "cost")
    assert len(curve.steps) == 2
    assert learning_curve(experiment, experiment.arms[1], "cost") is None
