import json

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from safe_wrappers.errors import RunStateError
from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluated_steps
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.run import Progress, train_run

SILENT = Progress(lambda steps: None, pytest.fail)


def evaluate(experiment, arm, seed=0, train=True):
    config = experiment.arms[arm]
    folder = experiment.run_folder(config, seed)
    if train:
        train_run(config, seed, folder, SILENT)
    evaluate_run(config, seed, folder, experiment.evaluation, experiment.evaluation_filter, SILENT)
    return folder / "evaluation"


def test_every_arm_sees_the_same_episodes_with_the_filter_off_and_on(fake_experiment):
    experiment = fake_experiment()
    folders = [evaluate(experiment, arm) for arm in (0, 1)]
    starts = []
    for folder in folders:
        for condition in ("filter_off", "filter_on"):
            rows = read_rows(folder / f"{condition}.csv")
            assert [row["episode_seed"] for row in rows] == [100, 101, 102]
            log = evaluated_steps(folder.parent, condition)
            starts.append(log.coordinates[log.step == 0].tolist())
            assert all(("intervention_rate" in row) == (condition == "filter_on") for row in rows)
            intervened = sum(row.get("intervention_rate", 0) for row in rows)
            assert log.intervened.sum() == pytest.approx(20 * intervened)
            if condition == "filter_off":
                assert intervened == 0
            else:
                assert sum(row["violations"] for row in rows) == 0
    assert starts == [starts[0]] * 4
    assert len({tuple(start) for start in starts[0]}) == 3


def test_the_steps_agree_with_the_table(fake_experiment):
    experiment = fake_experiment("arms.filtered.filter.kwargs.margin=0.6")  # so wide that it acts at once
    folder = evaluate(experiment, 1)
    changed = 0
    for condition in ("filter_off", "filter_on"):
        log = evaluated_steps(folder.parent, condition)
        rows = read_rows(folder / f"{condition}.csv")
        assert len(log) == sum(row["length"] for row in rows)
        for row in rows:
            at = log.episode_seed == row["episode_seed"]
            assert log.step[at].tolist() == list(range(int(row["length"])))
            assert log.intervened[at].mean() == pytest.approx(row.get("intervention_rate", 0))
            assert log.correction[at].mean() == pytest.approx(row.get("correction_mean", 0))
            assert log.violated[at].sum() == row["violations"]
            changed += log.intervened[at].sum()
    assert list(log.coordinate_names[:2]) == ["x (m)", "y (m)"]
    assert changed > 0


def test_done_once_and_again_when_its_settings_change(fake_experiment):
    folder = evaluate(fake_experiment(), 1)
    before = (folder / "filter_on.csv").stat().st_mtime_ns
    evaluate(fake_experiment(), 1)
    assert (folder / "filter_on.csv").stat().st_mtime_ns == before
    evaluate(fake_experiment("evaluation.episodes=4"), 1)
    assert len(read_rows(folder / "filter_on.csv")) == 4
    assert json.loads((folder / "evaluation.json").read_text())["settings"]["episodes"] == 4


def test_a_kill_between_the_conditions_leaves_nothing_that_looks_done(fake_experiment):
    folder = evaluate(fake_experiment(), 1)
    experiment = fake_experiment("evaluation.episodes=4")
    arm = experiment.arms[1]

    def kill(steps):
        if steps == 5:
            raise KeyboardInterrupt

    progress = Progress(kill, pytest.fail)
    with pytest.raises(KeyboardInterrupt):
        evaluate_run(arm, 0, folder.parent, experiment.evaluation, experiment.evaluation_filter, progress)
    evaluate(fake_experiment(), 1)  # the first settings again: their rows are gone, so they are made anew
    assert len(read_rows(folder / "filter_off.csv")) == len(read_rows(folder / "filter_on.csv")) == 3


def test_evaluation_reaches_tensorboard(fake_experiment):
    folder = evaluate(fake_experiment(), 1)
    events = EventAccumulator(str(folder.parent / "tensorboard"))
    events.Reload()
    tags = {tag for tag in events.Tags()["scalars"] if tag.startswith("evaluation")}
    assert {"evaluation_filter_on/cost", "evaluation_filter_off/return"} <= tags
    mean = np.mean([row["return"] for row in read_rows(folder / "filter_on.csv")])
    (event,) = events.Scalars("evaluation_filter_on/return")
    assert (event.step, event.value) == (512, pytest.approx(mean))


def test_an_untrained_run_is_refused(fake_experiment):
    with pytest.raises(RunStateError, match="is not trained to its end"):
        evaluate(fake_experiment(), 1, train=False)
