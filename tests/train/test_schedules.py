"""Learning rates that fall: the numbers of every update, in one go and continued after a kill."""

import pickle

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from test_run import Reports, run_killed_after

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.run import training as run_module
from safe_wrappers.train.run.checkpoint import latest_checkpoint
from safe_wrappers.train.run.model import LinearFall
from safe_wrappers.train.run.training import train_run

PPO = (
    "algorithm=PPO",
    "hyperparameters={n_steps: 32, batch_size: 32, n_epochs: 1, learning_rate: linear_1e-3, clip_range: linear_0.2}",
)
SAC = (
    "algorithm=SAC",
    "hyperparameters={learning_starts: 31, batch_size: 8, train_freq: 32, gradient_steps: 1,"
    " learning_rate: linear_1e-3}",
)


class Rates(BaseCallback):
    """The learning rate that the last update had, before each rollout: {steps: (rate, clip range)}."""

    def __init__(self, seen):
        super().__init__()
        self.seen = seen

    def _on_rollout_start(self):
        if self.num_timesteps and self.model._n_updates:
            policy = self.model.policy
            optimizer = getattr(policy, "optimizer", None) or self.model.actor.optimizer
            clip = getattr(self.model, "clip_range", None)
            used = clip(self.model._current_progress_remaining) if clip else None
            self.seen[self.num_timesteps] = (optimizer.param_groups[0]["lr"], used)

    def _on_step(self):
        return True


@pytest.mark.parametrize("settings", [PPO, SAC], ids=["PPO", "SAC"])
def test_a_continued_run_goes_on_with_the_schedule(fake_experiment, monkeypatch, settings):
    seen = {}
    monkeypatch.setattr(run_module, "InterventionCallback", lambda: Rates(seen))
    common = (*settings, "total_steps=256", "n_envs=1", "normalize={}", "checkpoint_every=64")
    whole = fake_experiment("name=whole", *common)
    train_run(whole.arms[1], 0, whole.run_folder(whole.arms[1], 0), Reports().progress)
    straight = dict(seen)
    seen.clear()
    killed = fake_experiment("name=killed", *common)
    folder = run_killed_after(killed, 1, monkeypatch)
    assert latest_checkpoint(folder / "checkpoints", pytest.fail).timesteps == 64
    before = dict(seen)
    seen.clear()
    train_run(killed.arms[1], 0, folder, Reports().progress)
    assert (
        min(seen) == 64 and max(before) <= 128
    )  # the rollout after the kill is the one behind the checkpoint
    assert straight.keys() == set(range(32, 256, 32))
    for rates in (straight, before, seen):
        for steps, (rate, clip) in rates.items():
            left = 1.0 - steps / 256
            assert rate == pytest.approx(1e-3 * left, rel=1e-12)
            assert clip is None or clip == pytest.approx(0.2 * left, rel=1e-12)


def test_a_rollout_beyond_the_end_does_not_unlearn(fake_experiment):
    experiment = fake_experiment(*PPO, "total_steps=100", "n_envs=1", "normalize={}")
    folder = experiment.run_folder(experiment.arms[1], 0)
    train_run(experiment.arms[1], 0, folder, Reports().progress)
    checkpoint = latest_checkpoint(folder / "checkpoints", pytest.fail)
    assert checkpoint.timesteps == 128
    model = checkpoint.load_model("PPO", None, "cpu")
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.0
    assert model.learning_rate == LinearFall(1e-3)
    assert [LinearFall(2.0)(left) for left in (1.0, 0.25, 0.0, -0.1)] == [2.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize("key", ["learning_rate", "clip_range", "clip_range_vf"])
@pytest.mark.parametrize("text", ["lin_3e-4", "linear_", "linear_-1", "linear_0", "linear_1.2.3", "linear_x"])
def test_other_texts_are_refused(fake_experiment, key, text):
    message = (
        f"hyperparameters.{key}: expected a number, or linear_<number> .* such as linear_3e-4, got '{text}'"
    )
    with pytest.raises(ConfigurationError, match=message):
        fake_experiment("algorithm=PPO", f"hyperparameters={{{key}: {text}}}")


def test_another_schedule_is_another_run(fake_experiment):
    fall, constant = (
        fake_experiment(f"hyperparameters={{learning_rate: {rate}}}").arms[0].fingerprint()
        for rate in ("linear_3e-4", "3e-4")
    )
    assert (
        fall["hyperparameters"]["learning_rate"]
        == "linear_3e-4"
        != constant["hyperparameters"]["learning_rate"]
    )


def test_a_checkpoint_s_schedule_is_found_again_where_checkpoints_of_before_say_it_is():
    assert pickle.loads(b"csafe_wrappers.train.hyperparameters\nLinearFall\n.") is LinearFall
