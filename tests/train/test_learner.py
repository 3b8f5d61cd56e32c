"""What each kind of learner is given in training, and that nothing of it is left in what is reported."""

import json

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from test_run import Reports, run_killed_after

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import ExecutedActionReplayBuffer
from safe_wrappers.train.config import EvaluationConfig, FilterConfig
from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluation_folder
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.run import training as run_module
from safe_wrappers.train.run.checkpoint import latest_checkpoint, load_model, resume
from safe_wrappers.train.run.stack import make_stack
from safe_wrappers.train.run.training import train_run

WALL = 0.0  # in the middle of where episodes start
PENALTY = 1000.0
"""An episode of the fake task returns less than 5, so that one penalty in a return would show."""


class BehindTheWall(sw.Constraint):
    """Ends no step right of the wall."""

    def rows(self):
        return sw.HalfSpaces(np.array([[self.plant.control_dt, 0.0]]), np.array([WALL - self.plant.state[0]]))

    def proposals(self, control):
        """Away from the wall, as fast as the point goes."""
        return [] if control is not None else [np.array([-1.0, 0.0])]


def drift(x):
    return np.zeros(2)


def push(x):
    return np.eye(2)


def read(env):
    return env.agent_position


def shield(env):
    """The fake task's point moves by 0.1 of its action: an integrator, held for 0.1 s."""
    plant = sw.AnalyticPlant(f=drift, g=push, state=read, control_dt=0.1)
    return sw.CBFActionFilter(env, [BehindTheWall()], plant=plant)


def one_arm(fake_experiment, learner, *overrides, algorithm="SAC"):
    """An experiment of one filtered arm."""
    settings = {
        "SAC": "hyperparameters={learning_starts: 64, batch_size: 16, policy_kwargs: {net_arch: [8]}}",
        "PPO": "hyperparameters={n_steps: 64, batch_size: 64, n_epochs: 2}",
    }
    arm = f"arms={{a: {{filter: {{factory: 'test_learner:shield'}}, learner: {learner}}}}}"
    return fake_experiment(
        f"algorithm={algorithm}", settings[algorithm], "total_steps=256", arm, "normalize={}", *overrides
    )


KINDS = {
    "naive": "naive",
    "adaption_penalty": f"{{kind: adaption_penalty, penalty: {PENALTY}, per_correction: 1.0}}",
    "safe_action": "safe_action",
}
TAKEN = [("SAC", kind) for kind in KINDS] + [("PPO", "naive"), ("PPO", "adaption_penalty")]


class Watch(BaseCallback):
    """What the algorithm was paid, beside the task's own reward."""

    def __init__(self):
        super().__init__()
        self.paid, self.infos = [], []

    def _on_step(self):
        self.paid.append(self.locals["rewards"].copy())
        self.infos.append(self.locals["infos"])
        return True


@pytest.mark.parametrize(("algorithm", "kind"), TAKEN)
def test_training_has_what_the_kind_says_and_the_rows_have_the_tasks_return(
    fake_experiment, monkeypatch, algorithm, kind
):
    experiment = one_arm(fake_experiment, KINDS[kind], algorithm=algorithm)
    (arm,) = experiment.arms
    folder = experiment.run_folder(arm, 0)
    watch, models = Watch(), []
    monkeypatch.setattr(run_module, "InterventionCallback", lambda: watch)
    monkeypatch.setattr(run_module, "write_policy", lambda *given: models.append(given[-1]))
    train_run(arm, 0, folder, Reports().progress)
    (model,) = models

    infos = np.array(watch.infos)  # (steps, envs)
    changed = np.array([[info[keys.CBF_INTERVENED] for info in row] for row in infos])
    assert 0.02 < changed.mean() < 0.98
    if arm.learner.penalised:
        taken = np.array([[info[keys.ADAPTION_PENALTY] for info in row] for row in infos])
        corrections = np.array([[info[keys.CBF_CORRECTION] for info in row] for row in infos])
        np.testing.assert_allclose(taken, changed * (PENALTY + corrections), rtol=1e-12)
        assert np.abs(np.array(watch.paid) + taken).max() < 1.0
    else:
        assert keys.ADAPTION_PENALTY not in infos[0, 0]
        assert np.abs(watch.paid).max() < 1.0

    rows = read_rows(folder / "episodes.csv")
    assert len(rows) == 2 * (128 // 20)
    assert all(abs(row["return"]) < 5 for row in rows)
    # What SB3 logs as rollout/ep_rew_mean is the same.
    ends = [info["episode"]["r"] for info in infos.ravel() if "episode" in info]
    assert sorted(ends) == pytest.approx(sorted(row["return"] for row in rows), abs=1e-5)
    assert set(model.ep_info_buffer[0]) >= {"r", "l"}

    if algorithm == "SAC":
        buffer = model.replay_buffer
        assert type(buffer) is (ExecutedActionReplayBuffer if arm.learner.stores_executed else ReplayBuffer)
        executed = np.array([[info[keys.EXECUTED_ACTION] for info in row] for row in infos], np.float32)
        difference = np.abs(buffer.actions[: len(infos)] - executed).max(axis=-1)
        assert (difference > 1e-6).any() == (not arm.learner.stores_executed)


@pytest.mark.parametrize(("algorithm", "kind"), [("SAC", "adaption_penalty"), ("PPO", "adaption_penalty")])
def test_evaluation_never_has_the_penalty(fake_experiment, monkeypatch, algorithm, kind):
    experiment = one_arm(fake_experiment, KINDS[kind], algorithm=algorithm)
    (arm,) = experiment.arms
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, Reports().progress)
    settings = EvaluationConfig(episodes=3, seed=7)
    monkeypatch.setattr("safe_wrappers.train.run.stack.AdaptionPenalty", pytest.fail)
    evaluate_run(arm, 0, folder, settings, FilterConfig(), Reports().progress)
    model = load_model(latest_checkpoint(folder / "checkpoints").folder, algorithm, "cpu")
    changed = 0
    for condition, action_filter in (("filter_off", FilterConfig()), ("filter_on", arm.filter)):
        rows = read_rows(evaluation_folder(folder) / f"{condition}.csv")
        env = make_stack(arm.env, action_filter)
        for row, seed in zip(rows, (7, 8, 9), strict=True):
            observation, _ = env.reset(seed=seed)
            start, done = env.unwrapped.agent_position.copy(), False
            while not done:
                observation, _, _, done, info = env.step(model.predict(observation, deterministic=True)[0])
                changed += info.get(keys.CBF_INTERVENED, False)
                assert keys.ADAPTION_PENALTY not in info
            # The task pays the distance to the goal that was gained.
            gained = np.linalg.norm([1.0, 0.0] - start) - np.linalg.norm([1.0, 0.0] - observation)
            assert row["return"] == pytest.approx(gained, abs=1e-6)
        env.close()
    assert changed, "with no changed step there would be nothing to leave out"
    assert json.loads((evaluation_folder(folder) / "evaluation.json").read_text())["timesteps"] == 256


def test_a_killed_run_goes_on_with_its_executed_actions(fake_experiment, monkeypatch):
    experiment = one_arm(fake_experiment, "safe_action", "n_envs=1", "checkpoint_every=64")
    (arm,) = experiment.arms
    folder = run_killed_after(experiment, 2, monkeypatch, arm=0)
    checkpoint = latest_checkpoint(folder / "checkpoints")
    envs = DummyVecEnv([lambda: make_stack(arm.env, arm.filter, arm.learner)])
    buffer = resume(checkpoint.folder, "SAC", envs, "cpu", 100).replay_buffer
    assert type(buffer) is ExecutedActionReplayBuffer
    assert buffer.size() == checkpoint.timesteps == 128
    assert (np.abs(buffer.rewards[:128]) < 1).all()
    train_run(arm, 0, folder, Reports().progress)
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 256


@pytest.mark.parametrize(
    ("learner", "overrides", "message"),
    [
        ("adaption_penalty", [], "adaption_penalty needs a penalty in units of the task's reward"),
        (
            "{kind: adaption_penalty, penalty: -1}",
            [],
            "learner.penalty: .* greater than or equal to 0, got -1",
        ),
        ("{penalty: 1}", [], "naive takes no penalty"),
        ("{kind: safe_action, penalty: 1}", [], "safe_action takes no penalty; adaption_penalty does"),
        ("safe_action", ["algorithm=DQN", "hyperparameters={}"], "is for continuous actions, and DQN has"),
        ("safe_action", ["arms.a.filter=none"], "without a filter no action is ever changed"),
        ("safe_action", ["hyperparameters.n_steps=3"], "has one-step returns"),
        ("safe_action", ["hyperparameters.replay_buffer_kwargs={}"], "unknown name 'replay_buffer_kwargs'"),
        (
            "safe_action",
            ["PPO"],
            "PPO cannot learn from the executed action: .* Use naive or adaption_penalty, or safe_action with SAC",
        ),
    ],
)
def test_what_does_not_go_together_is_refused_with_the_reason(fake_experiment, learner, overrides, message):
    algorithm = "PPO" if "PPO" in overrides else "SAC"
    with pytest.raises(ConfigurationError, match=message):
        one_arm(fake_experiment, learner, *(o for o in overrides if o != "PPO"), algorithm=algorithm)


def test_the_stack_puts_the_penalty_outside_recorder_and_monitor(fake_experiment):
    (arm,) = one_arm(fake_experiment, KINDS["adaption_penalty"]).arms
    env = make_stack(arm.env, arm.filter, arm.learner)
    assert isinstance(env, sw.AdaptionPenalty)
    assert (env.penalty, env.per_correction) == (arm.learner.penalty, arm.learner.per_correction)
    assert isinstance(env.env, Monitor) and isinstance(env.env.env, sw.RecordInterventions)
    assert isinstance(make_stack(arm.env, arm.filter), Monitor)
    with pytest.raises(ConfigurationError, match="AdaptionPenalty needs a CBFActionFilter inside"):
        make_stack(arm.env, FilterConfig(factory="fake_task:shield"), arm.learner)
