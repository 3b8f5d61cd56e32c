"""What a sweep may search, and which parameters are refused. None of this needs Optuna."""

import importlib.util
from pathlib import Path

import pytest
from rich.console import Console

from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.train.config import read_config
from safe_wrappers.train.sweep import Space, sweep_experiment

FAKE = Path(__file__).parent / "fake.yaml"
MARGIN = "arms.filtered.filter.kwargs.margin"


def settings(parameters, *overrides, **sweep):
    return {**read_config(FAKE, overrides), "sweep": {"parameters": parameters, **sweep}}


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"gama": {"low": 0.9, "high": 0.99}}, r"sweep.parameters.gama: .*unknown name 'gama'"),
        ({"hyperparameters.gama": {"low": 0.9, "high": 0.99}}, r"gamma"),
        ({"arms.filterd.filter": {"choices": ["none", "protect"]}}, r"Did you mean 'filtered'"),
        ({"arms": {"choices": [1, 2]}}, r"arms: unknown name ''"),
        ({MARGIN: {"low": 0.1, "high": 0.1}}, r"the range is empty: low is 0.1, high is 0.1"),
        ({MARGIN: {"low": 0.1}}, r"expected low and high"),
        ({MARGIN: {"low": 0.1, "high": 0.2, "choices": [1, 2]}}, r"low and high, or choices; got both"),
        ({MARGIN: {"choices": [0.1]}}, r"two or more different values, got \[0.1\]"),
        ({MARGIN: {"choices": [0.1, 0.1]}}, r"two or more different values"),
        ({MARGIN: {"low": 0, "high": 1, "log": True}}, r"log needs low above 0"),
        ({MARGIN: {"low": 0, "high": 4, "step": 0.5}}, r"step: low and high are integers"),
        ({MARGIN: {"low": "a", "high": 4}}, r"sweep.parameters.*low"),
        ({}, r"sweep.parameters: .*at least 1"),
        ({"total_steps": {"low": 100, "high": 500}}, r"compared at the same steps"),
        ({"evaluation.episodes": {"low": 1, "high": 5}}, r"changes nothing of what arm 'filtered' learns"),
        ({"name": {"choices": ["a", "b"]}}, r"changes nothing"),
        ({"normalize.observation.x": {"low": 1, "high": 5}}, r"normalize.observation is True, with no keys"),
        ({"n_envs": {"low": 0, "high": 5}}, r"sweep.parameters.n_envs: n_envs: .*greater than or equal to 1"),
        (
            {"arms.filtered.filter": {"choices": ["none", {"factory": "fake_task:shield"}]}},
            r"there is no filter",
        ),
    ],
)
def test_parameters_that_do_not_exist_or_decide_nothing_are_refused(parameters, said):
    with pytest.raises(ConfigurationError, match=said):
        Space(settings(parameters))


def test_an_arm_without_a_filter_anywhere_cannot_be_ranked():
    given = settings({"n_envs": {"low": 1, "high": 2}}, "arms={unfiltered: {filter: none}}")
    with pytest.raises(ConfigurationError, match="return with the filter on, and there is no filter"):
        Space(given)
    with pytest.raises(UnknownNameError, match=r"sweep\.arm"):
        Space(settings({"n_envs": {"low": 1, "high": 2}}, arm="filtred"))
    with pytest.raises(ConfigurationError, match="'sweep' is missing"):
        Space(read_config(FAKE))


def test_a_trial_is_the_ranked_arm_alone_with_the_drawn_values(tmp_path):
    space = Space(settings({MARGIN: {"low": 0.0, "high": 0.2}}, f"output={tmp_path}"))
    written, trial = space.trial("trial_0003", {MARGIN: 0.125})
    assert [arm.name for arm in trial.arms] == ["filtered"]
    assert trial.arms[0].filter.kwargs == {"margin": 0.125}
    assert trial.folder == tmp_path / "fake" / "sweep" / "trial_0003"
    assert "sweep" not in written
    assert space.experiment.arms[1].filter.kwargs == {"margin": 0.02}


def test_an_unfiltered_arm_keeps_the_filter_of_the_arm_that_is_left_out():
    space = Space(settings({MARGIN: {"low": 0.0, "high": 0.2}}, arm="unfiltered"))
    _, trial = space.trial("t", {MARGIN: 0.125})
    assert [arm.name for arm in trial.arms] == ["unfiltered"]
    assert trial.evaluation_filter.kwargs == {"margin": 0.125}


def test_arms_that_the_ranked_one_begins_with_are_trained_too():
    given = settings({"n_envs": {"low": 1, "high": 2}}, "arms.filtered.start_from=unfiltered")
    assert [arm.name for arm in Space(given).trial("t", {})[1].arms] == ["filtered", "unfiltered"]


def test_without_optuna_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match=r"pip install 'safe-wrappers\[sweep\]'"):
        sweep_experiment(settings({MARGIN: {"low": 0.0, "high": 0.2}}), FAKE, (), Console())
