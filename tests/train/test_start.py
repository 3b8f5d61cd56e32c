"""Fine-tuning: an arm begins with another arm's policy or with a file's, and with what scaled its observations."""

import json
import pickle

import gymnasium as gym
import pytest
import torch
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.save_util import load_from_zip_file

from safe_wrappers.envs.goal_env import SafeGoalEnv
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.train import experiment as experiment_steps
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.experiment import _start, generations, train_experiment
from safe_wrappers.train.report.page import about
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run.reset_options import ResetOptions
from safe_wrappers.train.run.training import finished_checkpoint
from safe_wrappers.train.run.vec_envs import make_training_env

QUIET = Progress(lambda _: None, lambda _: None)
TUNED = "arms.filtered.start_from=unfiltered"
# What is learned is lost in rounding: the policy afterwards is the one before.
STILL = "arms.filtered.hyperparameters.learning_rate=1e-20"


def quiet():
    return Console(quiet=True)


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


def statistics(checkpoint):
    return vars(pickle.loads((checkpoint.folder / "vecnormalize.pkl").read_bytes()))


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
        assert statistics(second)["obs_rms"].count == pytest.approx(statistics(first)["obs_rms"].count + 258)
        start = json.loads((experiment.run_folder(experiment.arms[1], seed) / "start.json").read_text())
        assert start == {"from": "unfiltered", "timesteps": 512}
        found.append(weights(second)["action_net.weight"])
    assert not torch.equal(*found)


def test_without_it_an_arm_begins_at_random(fake_experiment):
    first, second = train(fake_experiment(STILL, "seeds=[0]"))
    assert not torch.allclose(weights(second)["action_net.weight"], weights(first)["action_net.weight"])


def test_a_killed_run_goes_on_from_its_own_checkpoint_not_from_the_start(fake_experiment):
    short = fake_experiment(TUNED, "seeds=[0]", "arms.filtered.total_steps=256")
    before = weights(train(short)[1])
    more = fake_experiment(TUNED, "seeds=[0]", "arms.filtered.total_steps=512")
    arm = more.arms[1]
    said = []
    train_run(arm, 0, more.run_folder(arm, 0), Progress(lambda _: None, said.append))
    after = finished_checkpoint(arm, 0, more.run_folder(arm, 0))
    assert after.timesteps == 512 and not any("begins with" in line for line in said)
    assert not torch.equal(weights(after)["action_net.weight"], before["action_net.weight"])


def test_an_arm_begins_with_a_file(fake_experiment, tmp_path):
    first, _ = train(fake_experiment("seeds=[0]", "name=other"))
    path = first.folder / "model.zip"
    experiment = fake_experiment(f"arms.filtered.start_from={path}", STILL, "seeds=[0]")
    second = train(experiment)[1]
    assert torch.allclose(
        weights(second)["action_net.weight"], weights(first)["action_net.weight"], atol=1e-12
    )
    assert f"Arm filtered began with the policy of {path} after 512 steps" in about(experiment)
    assert "Arm unfiltered" not in about(experiment)


def test_the_optimizer_begins_anew(fake_experiment):
    first, second = train(fake_experiment(TUNED, STILL, "seeds=[0]"))
    steps = [
        load_from_zip_file(c.folder / "model.zip")[1]["policy.optimizer"]["state"][0]["step"].item()
        for c in (first, second)
    ]
    assert steps[0] == steps[1] > 0


def test_an_off_policy_policy_goes_on_too(fake_experiment):
    settings = ("hyperparameters=", "hyperparameters.learning_starts=16", "hyperparameters.batch_size=16")
    sac = ("algorithm=SAC", *settings, "total_steps=64", "seeds=[0]", TUNED, STILL)
    first, second = train(fake_experiment(*sac))
    theirs, ours = weights(first), weights(second)
    assert all(torch.allclose(ours[k], v, atol=1e-6) for k, v in theirs.items() if "target" not in k)


def test_the_command_trains_the_arm_first_that_another_begins_with(fake_experiment):
    experiment = fake_experiment("arms.unfiltered.start_from=filtered", "seeds=[0]")
    train_experiment(experiment, quiet())
    assert (experiment.run_folder(experiment.arms[0], 0) / "start.json").exists()
    assert [arm.name for arms in generations(experiment) for arm in arms] == ["filtered", "unfiltered"]


@pytest.mark.parametrize(
    ("overrides", "error", "words"),
    [
        (["arms.filtered.start_from=unfilterd"], UnknownNameError, "Did you mean 'unfiltered'"),
        (["arms.filtered.start_from=filtered"], UnknownNameError, "unfiltered"),
        ([TUNED, "arms.unfiltered.start_from=filtered"], ConfigurationError, "no arm can be trained first"),
        ([TUNED, "arms.unfiltered.algorithm=A2C"], ConfigurationError, "trained with A2C, this arm with PPO"),
        (["arms={a: {start_from: b}}"], ConfigurationError, "there is none"),
        (["start_from=unfiltered"], UnknownNameError, "start_from"),
    ],
)
def test_a_start_that_cannot_be_is_refused_when_the_config_is_read(fake_experiment, overrides, error, words):
    with pytest.raises(error, match=words):
        fake_experiment(*overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["arms.filtered.hyperparameters.policy_kwargs={net_arch: [32]}"], "has other weights.*policy_net"),
        (
            ["arms.filtered.normalize.observation=false"],
            "observations scaled, and the arm has them as they are",
        ),
        (["arms.unfiltered.env=InvertedPendulum-v5"], r"for another observation space: Box.*\(4,\)"),
        (["arms.filtered.start_from=nowhere.zip"], "no file 'nowhere.zip'"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused_before_anything_is_trained(fake_experiment, overrides, words):
    experiment = fake_experiment(TUNED, *overrides)
    with pytest.raises(ConfigurationError, match=words):
        train_experiment(experiment, quiet())
    assert not experiment.folder.exists()


def test_a_file_that_is_no_model_is_refused(fake_experiment, tmp_path):
    path = tmp_path / "policy.zip"
    path.write_bytes(b"no zip")
    with pytest.raises(ConfigurationError, match="no model that Stable-Baselines3 has saved"):
        train_experiment(fake_experiment(f"arms.filtered.start_from={path}"), quiet())


def test_a_file_without_statistics_does_not_fit_an_arm_that_scales(fake_experiment, tmp_path):
    experiment = fake_experiment()
    PPO("MlpPolicy", make_training_env(experiment.arms[0]), device="cpu").save(tmp_path / "policy.zip")
    with pytest.raises(ConfigurationError, match=r"vecnormalize\.pkl beside it"):
        train_experiment(fake_experiment(f"arms.filtered.start_from={tmp_path}/policy.zip"), quiet())


def test_a_run_that_begins_elsewhere_has_a_folder_of_its_own(fake_experiment):
    plain, tuned = fake_experiment().arms[1], fake_experiment(TUNED).arms[1]
    assert "start_from" not in plain.fingerprint()
    assert tuned.fingerprint() == plain.fingerprint() | {"start_from": "unfiltered"}


def hazards(env):
    return len(env.unwrapped.hazard_positions)


def test_reset_options_hold_in_training_alone(fake_experiment):
    bare = "env={id: SafePointGoal1-v0, reset_options: {layout: {hazards: []}}}"
    arm = fake_experiment(bare).arms[1]
    env = make_training_env(arm)
    for seed in (1, None):
        env.reset(seed=seed)
        assert hazards(env) == 0
    env.reset(seed=1, options={"layout": {"hazards": [[1.0, 1.0]]}})  # its own come on top
    assert hazards(env) == 1
    evaluated = gym.make(arm.env.id)
    evaluated.reset(seed=1)
    assert hazards(evaluated) > 0
    assert "reset_options" not in fake_experiment().arms[1].fingerprint()["env"]


def test_no_wrapper_without_reset_options(fake_experiment):
    assert not isinstance(make_training_env(fake_experiment().arms[0]), ResetOptions)


def test_an_option_that_the_task_does_not_know_is_refused_before_anything_is_trained(fake_experiment):
    experiment = fake_experiment("env={id: SafePointGoal1-v0, reset_options: {layout: {hazard: []}}}")
    with pytest.raises(UnknownNameError, match="hazard"):
        train_experiment(experiment, quiet())


def test_evaluation_resets_without_the_options(fake_experiment, monkeypatch):
    # Without a hazard there is no cost; with the task's own there is one.
    experiment = fake_experiment(
        "env={id: SafePointGoal1-v0, reset_options: {layout: {hazards: []}}}",
        "arms={alone: {filter: none}}",
        "seeds=[0]",
        "total_steps=128",
        "evaluation={episodes: 2, seed: 0}",
    )
    seen = []
    apply = SafeGoalEnv._apply

    def watching(self, layout):
        seen.append(len(layout.hazards))
        apply(self, layout)

    monkeypatch.setattr(SafeGoalEnv, "_apply", watching)
    arm = experiment.arms[0]
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, QUIET)
    assert set(seen) == {0}
    seen.clear()
    evaluate_run(arm, 0, folder, experiment.evaluation, experiment.evaluation_filter, QUIET)
    assert sum(count > 0 for count in seen) == 2  # the two episodes; an env that is made has no hazards yet


def test_the_time_left_is_of_all_arms(fake_experiment, monkeypatch):
    begun = []

    def note(jobs, workers, console, title, before, later, on):
        begun.append(([job.name for job in jobs], before, later))

    monkeypatch.setattr(experiment_steps, "run_jobs", note)
    experiment = fake_experiment(TUNED, "arms.filtered.total_steps=128")
    train_experiment(experiment, quiet())
    first, second = ([f"training {arm} seed {seed}" for seed in (0, 1)] for arm in ("unfiltered", "filtered"))
    assert begun == [(first, 0, 2 * 128), (second, 2 * 512, 0)]
