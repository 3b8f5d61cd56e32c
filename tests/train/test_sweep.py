"""A sweep over the fake task, and over trials whose outcome is made up."""

import csv
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from rich.console import Console

from safe_wrappers.errors import ConfigurationError, RunStateError
from safe_wrappers.train import sweep
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import read_config
from safe_wrappers.train.processes import Interrupted
from safe_wrappers.train.processes.parallel import RunsFailedError
from safe_wrappers.train.run import Progress
from safe_wrappers.train.sweep import Space

optuna = pytest.importorskip("optuna", reason="optuna is not installed: pip install 'safe-wrappers[sweep]'")

FAKE = Path(__file__).parent / "fake.yaml"
RATE, MARGIN = "hyperparameters.learning_rate", "arms.filtered.filter.kwargs.margin"
PARAMETERS = {RATE: {"low": 1e-5, "high": 1e-2, "log": True}, MARGIN: {"choices": [0.0, 0.1, 0.2]}}


def settings(folder, **given):
    overrides = [f"output={folder}", "total_steps=128", "seeds=[0]", "evaluation.episodes=1"]
    return {**read_config(FAKE, overrides), "sweep": {"parameters": PARAMETERS, **given}}


def searched(folder, changed=(), console=None, **given):
    """Searches, with other settings beside those of the sweep; returns the rows of its table by trial."""
    whole = {**settings(folder, **given), **dict(changed)}
    sweep.sweep_experiment(whole, FAKE, (), console or Console(quiet=True))
    return rows(folder)


def rows(folder):
    with (folder / "fake" / "sweep" / "sweep.csv").open() as file:
        return sorted(csv.DictReader(file), key=lambda row: int(row["trial"]))


@pytest.fixture
def in_process(monkeypatch):
    """Trials run here, one after the other; at which of their calls a signal comes, and which fail, is told."""
    told = SimpleNamespace(made=[], stops=set(), fails=set())

    def note(call):
        def noted(*given):
            told.made.append(call.__name__)
            if len(told.made) in told.stops:
                raise Interrupted(2)
            call(*given)

        return noted

    def run(jobs, *_, **__):
        failed = [job.name for job in jobs if job.name in told.fails]
        for job in jobs:
            if job.name not in failed:
                job.call(*job.arguments, Progress(lambda _: None, lambda _: None))
        if failed:
            raise RunsFailedError("too hot", failed)

    monkeypatch.setattr(sweep, "run_jobs", run)
    for name in ("train_run", "evaluate_run"):
        monkeypatch.setattr(sweep, name, note(getattr(sweep, name)))
    return told


def test_the_command_searches_and_its_trials_are_ordinary_experiments(tmp_path, capsys):
    config = tmp_path / "searched.yaml"
    config.write_text(yaml.safe_dump(settings(tmp_path, trials=2, at_once=2), sort_keys=False))
    assert main(["sweep", str(config), "workers=2"]) == 0
    told, found = capsys.readouterr().out, rows(tmp_path)
    assert [row["trial"] for row in found] == ["0", "1"]
    assert {row["state"] for row in found} == {"at cost zero"}
    best = max(found, key=lambda row: float(row["return"]))
    values = f"{RATE}={float(best[RATE])!r} {MARGIN}={best[MARGIN]}"
    assert f"safe-wrappers compare {config} workers=2 {values}" in told
    trial = tmp_path / "fake" / "sweep" / "trial_0001"
    assert main(["report", str(trial / "config.yaml")]) == 0
    assert (trial / "report.html").exists()
    tried = yaml.safe_load((trial / "config.yaml").read_text())
    assert tried["hyperparameters"]["learning_rate"] == float(found[1][RATE])
    assert [*tried["arms"]] == ["filtered"] and "sweep" not in tried  # the ranked arm
    assert main(["sweep", str(config)]) == 0  # all is done
    assert rows(tmp_path) == found


@pytest.mark.parametrize("stop", [4, 6])
def test_a_sweep_that_was_stopped_tries_the_same_as_one_that_was_not(tmp_path, in_process, stop):
    four = {"trials": 4, "at_once": 2}
    expected = searched(tmp_path / "a", **four)
    assert len(in_process.made) == 2 * 4 and len({row[RATE] for row in expected}) == 4
    in_process.made.clear()
    in_process.stops.add(stop)
    with pytest.raises(Interrupted):
        searched(tmp_path / "b", **four)
    assert searched(tmp_path / "b", **four) == expected


def test_a_study_of_other_settings_is_refused_but_for_more_trials(tmp_path, in_process):
    searched(tmp_path, trials=1)
    with pytest.raises(RunStateError, match="another sweep"):
        searched(tmp_path, trials=2, seed=1)
    assert len(searched(tmp_path, trials=2)) == 2


def test_a_trial_that_fails_is_left_out_and_the_others_go_on(tmp_path, in_process, capsys):
    in_process.fails.add("trial_0000")
    found = searched(tmp_path, trials=2, at_once=2)
    assert [row["state"] for row in found] == ["fail", "at cost zero"]
    assert found[0]["return"] == ""
    # So is one whose values the task refuses.
    coloured = {"env": {"id": "fake_task:FakeGoal-v0"}}
    colours = {"env.kwargs.colour": {"choices": ["red", "blue"]}}
    (row,) = searched(tmp_path / "b", coloured, Console(), trials=1, parameters=colours)
    told = capsys.readouterr().out
    assert row["state"] == "fail" and "trial_0000: " in told and "colour" in told
    assert "none is recommended" in told


def test_a_task_that_reports_no_cost_is_refused(tmp_path, in_process):
    with pytest.raises(ConfigurationError, match=r"the task reports no cost.*env\.judge"):
        searched(tmp_path, {"env": "fake_task:SilentGoal-v0"})


def test_a_violation_ranks_below_every_return_at_cost_zero():
    study = optuna.create_study(direction="maximize")
    for value, violations in ((9.0, 2.0), (1.0, 0.0), (99.0, None), (3.0, 0.0), (8.0, 0.5), (2.0, 0.0)):
        trial = study.ask()
        if violations is None:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        else:
            trial.set_constraint(sweep.VIOLATIONS, violations)
            study.tell(trial, value)
    assert [trial.number for trial in sweep.ranked(study)] == [3, 5, 1, 4, 0, 2]
    assert study.best_trial.number == 3  # Optuna's own opinion


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"hyperparameters.gama": {"low": 0.9, "high": 0.99}}, r"gamma"),
        ({"arms.filterd.filter": {"choices": ["none", "protect"]}}, r"Did you mean 'filtered'"),
        ({MARGIN: {"low": 0.1}}, r"expected .*low"),
        ({MARGIN: {"low": 0, "high": 4, "step": 0}}, r"expected .*low"),
        ({MARGIN: {"low": 0, "high": 4, "step": "x"}}, r"expected .*low"),
        ({"total_steps": {"low": 100, "high": 500}}, r"compared at the same steps"),
        ({"n_envs": {"low": 0, "high": 5}}, r"n_envs: .*greater than or equal to 1"),
        ({"arms.filtered.filter": {"choices": ["none", {"factory": "fake_task:shield"}]}}, r"there is no filter"),
    ],
)  # fmt: skip
def test_parameters_that_do_not_exist_or_are_refused(tmp_path, parameters, said):
    with pytest.raises(ConfigurationError, match=said):
        Space(settings(tmp_path, parameters=parameters))
