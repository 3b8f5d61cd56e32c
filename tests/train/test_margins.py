"""An arm's curriculum of margins: in training alone, over the whole of it, and refused where there is no margin."""

import json

import pytest
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.train.config import NAIVE, LearnerConfig
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.experiment import train_experiment
from safe_wrappers.train.run import Progress, train_run, training
from safe_wrappers.train.run.training import FINISHED_FILE
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter

REACHER = (
    "env=Reacher-v5",
    "normalize.observation=false",
    "arms={filtered: {filter: protect}}",
    "seeds=[0]",
    "n_envs=1",
    "hyperparameters={n_steps: 64, batch_size: 64, n_epochs: 1}",
    "total_steps=256",
    "evaluation={episodes: 1}",
)
CURRICULUM = "arms.filtered.learner.margin_curriculum={start: 1.0, end: 0.5, until: 0.5}"


class Margins(BaseCallback):
    """What the filter had at the run's steps."""

    seen: dict[int, float] = {}  # noqa: RUF012

    def _on_step(self):
        self.seen[self.num_timesteps] = self.training_env.get_attr("added_margin")[0]
        return True


@pytest.fixture
def margins(monkeypatch):
    monkeypatch.setattr(Margins, "seen", {})
    made = training.learner_callbacks
    monkeypatch.setattr(training, "learner_callbacks", lambda arm: [*made(arm), Margins()])
    return Margins.seen


def run(experiment):
    arm = experiment.arms[0]
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, Progress(lambda _: None, lambda _: None))
    return folder


def test_the_margin_narrows_in_training_and_goes_on_from_a_checkpoint(fake_experiment, margins):
    # The first half of the run as it stands when it is killed: with the whole total, and its own checkpoint.
    whole = fake_experiment(*REACHER, CURRICULUM)
    run(whole)
    expected = {64: 1.0, 128: 0.75, 192: 0.5, 256: 0.5}
    assert {step: margins[step] for step in expected} == expected and len(margins) == 256


def test_a_raised_total_goes_on_along_its_own_line(fake_experiment, margins):
    folder = run(fake_experiment(*REACHER, CURRICULUM))
    assert json.loads((folder / FINISHED_FILE).read_text())["timesteps"] == 256
    margins.clear()
    run(fake_experiment(*REACHER, CURRICULUM, "total_steps=1024"))
    # A quarter of the longer run is done: half of the way to `until`.
    assert margins[257] == 0.75 and margins[1024] == 0.5 and min(margins) == 257


def test_evaluation_has_the_filter_as_it_is_configured(fake_experiment, monkeypatch):
    experiment = fake_experiment(*REACHER, CURRICULUM)
    folder, arm, seen = run(experiment), experiment.arms[0], []
    judge = CBFActionFilter.judge

    def watching(self, action):
        seen.append((self.added_margin, self.constraints[0].margin))
        return judge(self, action)

    monkeypatch.setattr(CBFActionFilter, "judge", watching)
    quiet = Progress(lambda _: None, lambda _: None)
    evaluate_run(arm, 0, folder, experiment.evaluation, experiment.evaluation_filter, quiet)
    assert set(seen) == {(0.0, 0.01)} and len(seen) == 50


def test_narrow_first_is_allowed_as_long_as_it_is_never_below_the_recipe_s_margin(fake_experiment):
    narrow = "arms.filtered.learner.margin_curriculum={start: 0.0, end: 0.5}"
    given = fake_experiment(*REACHER, narrow).arms[0].learner.margin_curriculum
    assert (given.start, given.end, given.until) == (0.0, 0.5, 1.0)
    for below in ("{start: -0.005, end: 0.5}", "{start: 0.5, end: -0.005}"):
        with pytest.raises(ConfigurationError, match="greater than or equal to 0"):
            fake_experiment(*REACHER, f"arms.filtered.learner.margin_curriculum={below}")


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ("{start: 1.0, until: 1.5}", ConfigurationError, r"margin_curriculum\.until"),
        ("{start: 1.0, until: 0}", ConfigurationError, r"margin_curriculum\.until"),
        ("{end: 1.0}", ConfigurationError, "'start' is missing"),
        ("{begin: 1.0}", UnknownNameError, "start"),
    ],
)
def test_wrong_keys_and_numbers_are_refused(fake_experiment, given, error, words):
    with pytest.raises(error, match=words):
        fake_experiment(*REACHER, f"arms.filtered.learner.margin_curriculum={given}")


def test_without_a_filter_there_is_no_margin(fake_experiment):
    with pytest.raises(ConfigurationError, match="there is no margin"):
        fake_experiment("arms.unfiltered.learner.margin_curriculum={start: 0.1}")


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["arms.filtered.learner.margin_curriculum={start: 0.1}"], "has no set_margin"),
        ([*REACHER, "arms.filtered.learner.margin_curriculum={start: 5.0}"], "leaves nothing of the limit"),
    ],
)
def test_a_filter_that_cannot_have_the_margin_is_refused_before_training(fake_experiment, overrides, words):
    experiment = fake_experiment(*overrides)
    with pytest.raises(ConfigurationError, match=words):
        train_experiment(experiment, Console(quiet=True))
    assert not experiment.folder.exists()


def test_folders_of_older_runs_go_on(fake_experiment):
    plain, narrowing = (fake_experiment(*REACHER, *more).arms[0].fingerprint() for more in ([], [CURRICULUM]))
    assert "learner" not in plain
    assert narrowing["learner"]["margin_curriculum"] == {"start": 1.0, "end": 0.5, "until": 0.5}
    penalised = fake_experiment("arms.filtered.learner={kind: adaption_penalty, penalty: 0.1}").arms[1]
    assert set(penalised.fingerprint()["learner"]) == {"kind", "penalty", "per_correction"}
    assert LearnerConfig() == NAIVE
