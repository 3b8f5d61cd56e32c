"""Hindsight replay asked for in a config: what is refused, what is made, and runs on the public goal tasks."""

import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from stable_baselines3 import HerReplayBuffer
from test_run import Reports, run_killed_after

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import ExecutedActionHerReplayBuffer
from safe_wrappers.train.config import EvaluationConfig, FilterConfig
from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluation_folder
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.run.checkpoint import latest_checkpoint, resume
from safe_wrappers.train.run.model import check_task
from safe_wrappers.train.run.stack import make_stack, make_vec_env
from safe_wrappers.train.run.training import train_run

HER = (
    "hyperparameters={policy: MultiInputPolicy, learning_starts: 32, batch_size: 16, train_freq: 8,"
    " policy_kwargs: {net_arch: [8]}, replay_buffer_class: HerReplayBuffer,"
    " replay_buffer_kwargs: {n_sampled_goal: 2}}"
)
LEARNERS = {
    "naive": "naive",
    "adaption_penalty": "{kind: adaption_penalty, penalty: 7.0}",
    "safe_action": "safe_action",
    "both": "{kind: both, penalty: 7.0}",
    "safe_set_map": "safe_set_map",
}
SB3S_BUFFER = ("naive", "safe_set_map")


class Goals(gym.Wrapper):
    """The fake task with its goal in the observation."""

    def __init__(self, env):
        super().__init__(env)
        parts = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = Dict({part: Box(-np.inf, np.inf, (2,), np.float64) for part in parts})

    def _dict(self, at):
        return {"observation": at, "achieved_goal": at, "desired_goal": self.unwrapped.goal_position}

    def reset(self, **given):
        at, info = super().reset(**given)
        return self._dict(at), info

    def step(self, action):
        at, _, terminated, truncated, info = super().step(action)
        reward = float(self.compute_reward(at, self.unwrapped.goal_position, info))
        return self._dict(at), reward, terminated, truncated, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -(np.linalg.norm(achieved_goal - desired_goal, axis=-1) > 0.2).astype(float)


def goals():
    return Goals(gym.make("fake_task:FakeGoal-v0", max_episode_steps=20))


gym.register("GoalsInSight-v0", goals)


def one_arm(fake_experiment, learner, *overrides):
    return fake_experiment(
        "algorithm=SAC",
        "env=test_her:GoalsInSight-v0",
        HER,
        f"arms={{a: {{filter: {{factory: 'test_learner:shield'}}, learner: {LEARNERS.get(learner, learner)}}}}}",
        "total_steps=192",
        "n_envs=1",
        "checkpoint_every=64",
        "normalize={}",
        *overrides,
    )


@pytest.mark.parametrize("kind", LEARNERS)
def test_trained_killed_continued_and_evaluated(fake_experiment, monkeypatch, recwarn, kind):
    experiment = one_arm(fake_experiment, kind)
    (arm,) = experiment.arms
    check_task(arm, make_stack(arm.env, arm.filter, arm.learner))
    folder = run_killed_after(experiment, 1, monkeypatch, arm=0)
    checkpoint = latest_checkpoint(folder / "checkpoints")
    buffer = resume(checkpoint.folder, "SAC", make_vec_env(arm), "cpu", 100).replay_buffer
    assert type(buffer) is (HerReplayBuffer if kind in SB3S_BUFFER else ExecutedActionHerReplayBuffer)
    assert getattr(buffer, "mode", kind) == kind
    assert (buffer.size(), buffer.n_sampled_goal) == (64, 2)
    assert buffer.sample(9).rewards[3:].min() < -6 or kind in ("safe_action", *SB3S_BUFFER)
    # The episode that the kill cut is whole: there are new ones after it.
    assert (buffer.ep_length[:64] > 0).all() and buffer.timeouts[63, 0] == 1.0
    train_run(arm, 0, folder, Reports().progress)
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 192
    evaluate_run(arm, 0, folder, EvaluationConfig(2, 7), FilterConfig(), Reports().progress)
    assert len(read_rows(evaluation_folder(folder) / "filter_on.csv")) == 2
    assert not [warning for warning in recwarn if "trajectory" in str(warning.message)]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("hyperparameters.replay_buffer_class=ReplayBuffer", "unknown name 'ReplayBuffer'. Did you mean"),
        ("hyperparameters.n_steps=3", "have one-step returns"),
        ("env={id: test_her:GoalsInSight-v0, occlusion: {weight: 1.0}}", "asks the task for rewards anew"),
        ("arms.a.learner={cost_limit: 1}", "asks the task for rewards anew"),
    ],
)
def test_settings_that_do_not_fit_are_refused(fake_experiment, override, message):
    with pytest.raises(ConfigurationError, match=message):
        one_arm(fake_experiment, "naive", override)


def test_what_only_the_task_tells_is_refused_before_the_first_step(fake_experiment):
    for overrides, message in (
        (
            ["env=fake_task:FakeGoal-v0"],
            "needs observations that are a Dict with achieved_goal, desired_goal, obs",
        ),
        (["n_envs=2"], "With 2 envs of 20 steps .* has to be at least 40; it is 32"),
    ):
        (arm,) = one_arm(fake_experiment, "naive", *overrides).arms
        with pytest.raises(ConfigurationError, match=message):
            check_task(arm, make_stack(arm.env, arm.filter, arm.learner))
    (arm,) = one_arm(fake_experiment, "naive", "n_envs=2", "hyperparameters.learning_starts=40").arms
    check_task(arm, make_stack(arm.env, arm.filter, arm.learner))


PUBLIC = {
    "FetchReach-v4": (
        "{id: gymnasium_robotics:FetchReach-v4, kwargs: {max_episode_steps: 25},"
        " faults: {Outages: {mean_between_s: 9.0, mean_length_s: 0.1}}}",
        4,
    ),
    "PointMaze_UMaze-v3": ("{id: gymnasium_robotics:PointMaze_UMaze-v3, kwargs: {max_episode_steps: 25}}", 2),
}


@pytest.mark.parametrize("name", PUBLIC)
def test_compute_reward_is_the_tasks_through_the_whole_stack(fake_experiment, name):
    pytest.importorskip("gymnasium_robotics")
    env, nu = PUBLIC[name]
    (arm,) = one_arm(fake_experiment, "both", f"env={env}", "arms.a.filter=protect").arms
    envs = make_vec_env(arm)
    envs.seed(0)
    before = envs.reset()
    rng = np.random.default_rng(0)
    for _ in range(20):
        after, reward, _, (info,) = envs.step(rng.uniform(-1, 1, (1, nu)))
        (own,) = envs.env_method(
            "compute_reward", after["achieved_goal"], before["desired_goal"], [{}], indices=[0]
        )
        assert own == info[keys.ADAPTION_TASK_REWARD]
        assert reward == np.float32(info[keys.ADAPTION_TASK_REWARD] - info[keys.ADAPTION_PENALTY])
        before = after
    here = after["achieved_goal"]
    (paid,) = envs.env_method("compute_reward", here, here, [{}], indices=[0])
    assert paid == {"FetchReach-v4": 0.0, "PointMaze_UMaze-v3": 1.0}[name]
