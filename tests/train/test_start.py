"""Fine-tuning: an arm begins with another arm's policy or with a file's, and with what scaled its observations."""

import json

import gymnasium as gym
import pytest
import torch
from rich.console import Console
from stable_baselines3.common.save_util import load_from_zip_file
from test_run import Reports

from safe_wrappers.envs.goal_env import SafeGoalEnv
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.experiment import _start, generations, train_experiment
from safe_wrappers.train.run import train_run
from safe_wrappers.train.run.data_pickles import read_pickle
from safe_wrappers.train.run.stack import make_training_env
from safe_wrappers.train.run.training import finished_checkpoint

QUIET = Reports().progress
TUNED = "arms.filtered.start_from=unfiltered"
# What is learned is lost in rounding: the policy afterwards is the one before.
STILL = "arms.filtered.hyperparameters.learning_rate=1e-20"


def train(experiment):
    """In this process; the checkpoints of seed 0."""
    for arms in generations(experiment):
        for arm in arms:
            for seed in experiment.seeds:
                start = _start(experiment, arm, seed)
                train_run(arm, seed, experiment.run_folder(arm, seed), QUIET, start)
    return [finished_checkpoint(arm, 0, experiment.run_folder(arm, 0)) for arm in experiment.arms]


def weights(checkpoint):
    return load_from_zip_file(checkpoint.folder / "model.zip")[1]["policy"]


def seen(checkpoint):
    return vars(read_pickle(checkpoint.folder / "vecnormalize.pkl"))["obs_rms"].count


def test_an_arm_begins_with_the_policy_of_another_of_the_same_seed(fake_experiment):
    experiment = fake_experiment(TUNED, STILL, "arms.filtered.total_steps=256")
    train(experiment)
    found = []
    for seed in experiment.seeds:
        first, second = (
            finished_checkpoint(arm, seed, experiment.run_folder(arm, seed)) for arm in experiment.arms
        )
        assert all(torch.allclose(weights(second)[k], v, atol=1e-12) for k, v in weights(first).items())
        assert (first.timesteps, second.timesteps) == (512, 256)  # its own steps
        # The statistics go on from where the other run left them; SB3 adds the 2 observations of the first reset.
        assert seen(second) == pytest.approx(seen(first) + 258)
        start = json.loads((experiment.run_folder(experiment.arms[1], seed) / "start.json").read_text())
        assert start == {"from": "unfiltered", "timesteps": 512}
        found.append(weights(second)["action_net.weight"])
    assert not torch.equal(*found)
    # Once begun it goes on from its own checkpoint.
    after = train(fake_experiment(TUNED, STILL, "arms.filtered.total_steps=512"))[1]
    assert after.timesteps == 512 and seen(after) < 512 + 512 + 9


def test_an_arm_begins_with_a_file(fake_experiment):
    first, _ = train(fake_experiment("seeds=[0]", "name=other"))
    path = first.folder / "model.zip"
    second = train(fake_experiment(f"arms.filtered.start_from={path}", STILL, "seeds=[0]"))[1]
    assert torch.allclose(
        weights(second)["action_net.weight"], weights(first)["action_net.weight"], atol=1e-12
    )


def test_an_off_policy_policy_goes_on_too(fake_experiment):
    settings = ("hyperparameters=", "hyperparameters.learning_starts=16", "hyperparameters.batch_size=16")
    sac = ("algorithm=SAC", *settings, "total_steps=64", "seeds=[0]", TUNED, STILL)
    first, second = train(fake_experiment(*sac))
    theirs, ours = weights(first), weights(second)
    assert all(torch.allclose(ours[k], v, atol=1e-6) for k, v in theirs.items() if "target" not in k)


@pytest.mark.parametrize(
    ("overrides", "error", "words"),
    [
        (["arms.filtered.start_from=unfilterd"], UnknownNameError, "Did you mean 'unfiltered'"),
        (["arms.unfiltered.start_from=filtered"], UnknownNameError, "an arm before this one"),
        ([TUNED, "arms.unfiltered.algorithm=A2C"], ConfigurationError, "trained with A2C, this arm with PPO"),
        (["start_from=unfiltered"], UnknownNameError, "start_from"),
    ],
)
def test_a_start_that_cannot_be_is_refused_when_the_config_is_read(fake_experiment, overrides, error, words):
    with pytest.raises(error, match=words):
        fake_experiment(*overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["arms.filtered.hyperparameters.policy_kwargs={net_arch: [32]}"], "other weights .*policy_net"),
        (["arms.filtered.normalize.observation=false"], "observations of another scaling"),
        (["arms.unfiltered.env=InvertedPendulum-v5"], "another observation_space: Box"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(fake_experiment, overrides, words):
    experiment = fake_experiment(TUNED, *overrides, "seeds=[0]", "total_steps=128")
    with pytest.raises(ConfigurationError, match=rf"(?s)arms.filtered: the policy of unfiltered.*{words}"):
        train(experiment)
    assert not experiment.run_folder(experiment.arms[1], 0).joinpath("run.json").exists()


def test_a_file_that_is_none_is_refused(fake_experiment, tmp_path):
    with pytest.raises(ConfigurationError, match=r"start_from: there is no file 'nowhere\.zip'"):
        train_experiment(fake_experiment("arms.filtered.start_from=nowhere.zip"), Console(quiet=True))
    (tmp_path / "policy.zip").write_bytes(b"no zip")
    with pytest.raises(ConfigurationError, match="is no model of SB3"):
        train(fake_experiment(f"arms.filtered.start_from={tmp_path}/policy.zip", "seeds=[0]"))


BARE = "env={id: SafePointGoal1-v0, reset_options: {layout: {hazards: []}}}"


def test_reset_options_hold_in_training_and_not_in_evaluation(fake_experiment, monkeypatch):
    experiment = fake_experiment(
        BARE, "arms={alone: {filter: none}}", "total_steps=128", "evaluation={episodes: 2, seed: 0}"
    )
    found = []
    apply = SafeGoalEnv._apply

    def watching(self, layout):
        found.append(len(layout.hazards))
        apply(self, layout)

    monkeypatch.setattr(SafeGoalEnv, "_apply", watching)
    arm = experiment.arms[0]
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, QUIET)
    assert set(found) == {0}
    found.clear()
    evaluate_run(arm, 0, folder, experiment.evaluation, experiment.evaluation_filter, QUIET)
    assert sum(count > 0 for count in found) == 2  # the two episodes; an env that is made has no hazards yet
    env = make_training_env(arm)
    env.reset(seed=1, options={"layout": {"hazards": [[1.0, 1.0]]}})  # its own come on top
    assert len(env.unwrapped.hazard_positions) == 1
    evaluated = gym.make(arm.env.id)
    evaluated.reset(seed=1)
    assert len(evaluated.unwrapped.hazard_positions) > 1


def test_an_option_that_the_task_does_not_know_is_refused_before_anything_is_trained(fake_experiment):
    with pytest.raises(UnknownNameError, match="hazard"):
        train_experiment(fake_experiment(BARE.replace("hazards", "hazard")), Console(quiet=True))
