"""Every drawn transition against the closed form of task, filter and penalty, and against SB3's own HER buffer."""

import functools

import numpy as np
import pytest
import torch
from goal_line import filtered
from line_world import HOLD, WALL
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from safe_wrappers.sb3 import ExecutedActionHerReplayBuffer

torch.set_num_threads(1)


def learn(make=filtered, n_envs=2, vec_env=DummyVecEnv, buffer=None, normalize=False, **more):
    """A model with the buffer under test and 120 steps in it; it has learnt from half of them if asked to."""
    envs = vec_env([make] * n_envs)
    buffer_size, learning_starts = more.pop("buffer_size", 400), more.pop("learning_starts", 1000)
    model = SAC(
        "MultiInputPolicy",
        VecNormalize(envs) if normalize else envs,
        buffer_size=buffer_size,
        learning_starts=learning_starts,
        batch_size=16,
        replay_buffer_class=buffer or ExecutedActionHerReplayBuffer,
        replay_buffer_kwargs=more,
        policy_kwargs={"net_arch": [8]},
        seed=0,
        device="cpu",
    )
    return model.learn(120)


class Drawn:
    """A batch as the task's own numbers."""

    def __init__(self, samples):
        before, after = (
            {k: v.numpy() for k, v in part.items()}
            for part in (samples.observations, samples.next_observations)
        )
        self.x, _, self.number = before["observation"].T
        self.x_after, self.steps_after, _ = after["observation"].T
        self.goal, self.goal_after = before["desired_goal"].ravel(), after["desired_goal"].ravel()
        self.achieved = after["achieved_goal"].ravel()
        self.action, self.reward = samples.actions.numpy().ravel(), samples.rewards.numpy().ravel()
        self.done = samples.dones.numpy().ravel()
        self.sent = -2.0 + (self.action + 1.0) * 2.5  # unscaled
        self.moved = (self.x_after - self.x) / HOLD
        # The filter lets through what it can: a transition of which the wall stopped a part has the policy's action.
        self.refused = self.sent - self.moved > 1e-4

    def rows(self):
        return np.stack([getattr(self, name) for name in sorted(vars(self))])


def draw(buffer, count, seed=1):
    np.random.seed(seed)
    return Drawn(buffer.sample(count))


def episodes(buffer):
    """The whole episodes of a buffer that is not full: (env, slots in order)."""
    cut = [np.flatnonzero(buffer.dones[: buffer.pos, env]) + 1 for env in range(buffer.n_envs)]
    return [
        (env, np.arange(start, end))
        for env, ends in enumerate(cut)
        for start, end in zip(np.r_[0, ends[:-1]], ends, strict=True)
    ]


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_every_transition_is_the_executed_one(strategy):
    buffer = learn(goal_selection_strategy=strategy).replay_buffer
    drawn = draw(buffer, 1000)
    np.testing.assert_array_equal(drawn.goal, drawn.goal_after)
    np.testing.assert_array_equal(drawn.x_after, drawn.achieved)
    # Where the point went tells which action was executed, and the wall what it is if that was not the policy's.
    executed = np.abs(drawn.sent - drawn.moved) < 1e-4
    assert (executed ^ drawn.refused).all()
    assert not drawn.refused.any()
    largest = (WALL - drawn.x) / HOLD
    stopped = np.abs(drawn.moved - largest) < 1e-4
    assert 50 < stopped.sum() < 950
    np.testing.assert_allclose(drawn.reward, -np.abs(drawn.x_after - drawn.goal), atol=1e-4)

    # Goals: of the first fifth the episode's own; of the others where the episode was, then or later.
    where = {}
    for env, slots in episodes(buffer):
        reached = buffer.next_observations["achieved_goal"][slots, env, 0]
        seen = buffer.observations["observation"][slots, env]
        for at, (_, _, number) in enumerate(seen):
            own = buffer.observations["desired_goal"][slots[at], env, 0]
            later = {"future": reached[at:], "final": reached[-1:], "episode": reached}[strategy]
            last = slots[at] == slots[-1] and reached[-1] < -1.0  # the others are cut off by their length
            where[number] = (own, set(later), last)
    for at, number in enumerate(drawn.number):
        own, later, last = where[number]
        assert drawn.goal[at] == own if at < 200 else drawn.goal[at] in later
        assert drawn.done[at] == last


@pytest.mark.parametrize("n_envs", [1, 2])
def test_without_a_changed_step_it_is_sb3s_buffer_bit_for_bit(n_envs):
    far = functools.partial(filtered, wall=100.0)
    ours = learn(far, n_envs, learning_starts=100)
    theirs = learn(far, n_envs, learning_starts=100, buffer=HerReplayBuffer)
    assert type(theirs.replay_buffer) is HerReplayBuffer
    for mine, other in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert torch.equal(mine, other)
    for count in (1, 7, 64):
        mine, other = (draw(model.replay_buffer, count).rows() for model in (ours, theirs))
        np.testing.assert_array_equal(mine, other)


def test_saved_loaded_and_gone_on_with(tmp_path):
    model = learn()
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    again = SAC.load(tmp_path / "model", env=DummyVecEnv([filtered] * 2), device="cpu")
    assert type(again.replay_buffer) is ExecutedActionHerReplayBuffer and again.replay_buffer.size() == 0
    again.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    first = draw(model.replay_buffer, 64).rows()
    np.testing.assert_array_equal(draw(again.replay_buffer, 64).rows(), first)
    with pytest.warns(UserWarning, match="last trajectory"):
        again.load_replay_buffer(tmp_path / "buffer")
    again.learn(20, reset_num_timesteps=False)
    assert again.replay_buffer.size() == 60 + 10
    # The episode that the kill cut is whole now, and no one else's.
    drawn = draw(again.replay_buffer, 2000)
    np.testing.assert_allclose(drawn.reward, -np.abs(drawn.x_after - drawn.goal), atol=1e-4)
    last = again.replay_buffer.observations["observation"][59, :, 2]
    assert np.isin(last, drawn.number).all()
