"""The buffers against a record that the env and a callback keep, the closed form of the filter, and SB3's own."""

import functools
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch
from asking import Below
from gymnasium.spaces import Box, Dict, Discrete
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.sb3 import (
    ExecutedActionDictReplayBuffer,
    ExecutedActionHerReplayBuffer,
    ExecutedActionReplayBuffer,
)

torch.set_num_threads(1)


# A point on a line, pushed left and right, and a filter that is known in closed form; with and without goals ------

HOLD, WALL = 0.1, -0.3


class Line(gym.Env):
    """x' = u with u in [-2, 3], so that scaling is no identity; ends left of -1, is cut off after 9 steps.

    What it was given, from where, and what it paid, is in info, for a record that no wrapper has touched.
    """

    def __init__(self):
        self.action_space = Box(-2.0, 3.0, (1,), np.float32)
        self.observation_space = Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = float(self.np_random.uniform(-0.8, -0.4)), 0
        return self.observed(), {}

    def observed(self):
        return np.array([self.x, self.steps], np.float32)

    def step(self, action):
        given, before = float(action[0]), self.x
        self.x += HOLD * given
        self.steps += 1
        reward = 10.0 * self.x + 12.0 - 0.3 * given**2
        info = {"truth": {"given": given, "before": before, "paid": reward, "after": self.observed()}}
        return self.observed(), reward, self.x < -1.0, self.steps >= 9, info


class GoalLine(Line):
    """Pays minus the distance to a goal that is drawn at every reset; each observation has a number of its own."""

    def __init__(self):
        super().__init__()
        one = Box(-np.inf, np.inf, (1,), np.float32)
        three = Box(-np.inf, np.inf, (3,), np.float32)
        parts = {"observation": three, "achieved_goal": one, "desired_goal": one}
        self.observation_space = Dict(parts)

    def reset(self, *, seed=None, options=None):
        self.goal = np.zeros(1, np.float32)
        super().reset(seed=seed)
        self.goal = self.np_random.uniform(-1.0, 0.5, 1).astype(np.float32)
        return self.observed(), {}

    def observed(self):
        at = np.append(super().observed(), self.np_random.uniform()).astype(np.float32)
        return {"observation": at, "achieved_goal": at[:1].copy(), "desired_goal": self.goal.copy()}

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        reward = self.compute_reward(observation["achieved_goal"], self.goal, info)
        return observation, float(reward), terminated, truncated, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        """Minus the distance, (...), in the precision of the goals."""
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)


def filtered(wall=WALL, task=Line):
    plant = sw.AnalyticPlant(
        f=lambda x: np.zeros(1),
        g=lambda x: np.ones((1, 1)),
        state=lambda env: np.array([env.x]),
        control_dt=HOLD,
    )
    return Monitor(sw.RecordInterventions(sw.CBFActionFilter(task(), [Below(wall)], plant=plant)))


def filtered_goals(wall=WALL):
    return filtered(wall, GoalLine)


def filtered_dict(wall=WALL):
    """The same observation in two parts."""
    one = Box(-np.inf, np.inf, (1,))
    return gym.wrappers.TransformObservation(
        filtered(wall), lambda seen: {"x": seen[:1], "steps": seen[1:]}, Dict({"x": one, "steps": one})
    )


# The record -------------------------------------------------------------------------------------------------------


class Record(BaseCallback):
    """What the algorithm chose and saw, and what the env says was done, before the buffer hears of it."""

    def __init__(self):
        super().__init__()
        self.steps = []

    def _on_step(self):
        seen = self.locals
        truths = [info["truth"] for info in seen["infos"]]
        self.steps.append(
            {
                "observed": self.model._last_obs,
                "sent": np.array(seen["actions"]),
                "stored": np.array(seen["buffer_actions"]),
                "reward": np.array(seen["rewards"], np.float32),  # of processes they come in float64
                "done": np.array(seen["dones"]),
                "cut": np.array([info["TimeLimit.truncated"] for info in seen["infos"]]),
                **{key: np.array([truth[key] for truth in truths]) for key in truths[0]},
            }
        )
        return True

    def __getitem__(self, key):
        """(steps, envs, ...)"""
        return np.stack([step[key] for step in self.steps])


def learn(make=filtered, n_envs=2, steps=120, buffer=ExecutedActionReplayBuffer, normalize=False, **settings):
    """A trained model with the buffer under test, and the record of its steps."""
    envs = DummyVecEnv([make] * n_envs)
    model = SAC(
        "MlpPolicy" if isinstance(envs.observation_space, Box) else "MultiInputPolicy",
        VecNormalize(envs) if normalize else envs,
        replay_buffer_class=buffer,
        policy_kwargs={"net_arch": [8]},
        seed=0,
        device="cpu",
        **{"buffer_size": 1000, "learning_starts": 60, "batch_size": 16, **settings},
    )
    record = Record()
    model.learn(steps, callback=record)
    return model, record


def draw(buffer, count, seed=1, **more):
    """Observation, action, next observation, done, reward of a batch; dicts part by part."""
    np.random.seed(seed)
    parts = []
    for part in buffer.sample(count, **more)[:5]:
        parts += part.values() if isinstance(part, dict) else [part]
    return np.concatenate([part.numpy() for part in parts], axis=1)


def test_it_holds_slot_by_slot_what_the_record_and_the_closed_form_filter_say():
    model, record = learn()
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())
    buffer, n = model.replay_buffer, len(record.steps)
    assert buffer.size() == n
    sent, given = record["sent"][..., 0], record["given"]
    np.testing.assert_allclose(given, np.minimum(sent, (WALL - record["before"]) / HOLD), atol=1e-5)
    changed = given != sent
    assert 0.05 < changed.mean() < 0.95, "the run shows both kinds of steps"
    assert record["done"].any() and not record["done"].all()

    stored, task = record["stored"], record["paid"].astype(np.float32)
    # As SB3 scales them, in float32; what was not changed is what SB3 would have stored, bit for bit.
    executed = model.policy.scale_action(given.astype(np.float32)[..., None])
    same = {
        "observations": record["observed"],
        "actions": np.where(changed[..., None], executed, stored),
        "rewards": task,
        "next_observations": record["after"],  # the env's last observation, not the next episode's first
        "dones": record["done"],
        "timeouts": record["cut"],
    }
    np.testing.assert_array_equal(record["reward"], task)
    for name, expected in same.items():
        np.testing.assert_array_equal(getattr(buffer, name)[:n], expected, err_msg=name)


BUFFERS = {
    "flat": (filtered, ExecutedActionReplayBuffer, ReplayBuffer, 1),
    "dict": (filtered_dict, ExecutedActionDictReplayBuffer, DictReplayBuffer, 2),
    "goals": (filtered_goals, ExecutedActionHerReplayBuffer, HerReplayBuffer, 2),
}


@pytest.mark.parametrize(("make", "ours", "theirs", "n_envs"), BUFFERS.values(), ids=BUFFERS)
def test_without_a_changed_step_it_is_sb3s_buffer_bit_for_bit(make, ours, theirs, n_envs):
    far = functools.partial(make, wall=100.0)
    (mine, record), (other, _) = (learn(far, n_envs, buffer=buffer) for buffer in (ours, theirs))
    assert type(other.replay_buffer) is theirs
    assert (record["given"] == record["sent"][..., 0]).all()
    for here, there in zip(mine.policy.parameters(), other.policy.parameters(), strict=True):
        assert torch.equal(here, there)
    for count in (1, 7, 64):
        np.testing.assert_array_equal(*(draw(model.replay_buffer, count) for model in (mine, other)))


@pytest.mark.parametrize(("make", "buffer"), [row[:2] for row in BUFFERS.values()], ids=BUFFERS)
def test_saved_loaded_and_gone_on_with(tmp_path, make, buffer):
    model, record = learn(make, buffer=buffer)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    again = SAC.load(tmp_path / "model", env=DummyVecEnv([make] * 2), device="cpu")
    assert type(again.replay_buffer) is buffer and again.replay_buffer.size() == 0
    again.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    changed = record["given"] != record["sent"][..., 0]
    executed = model.policy.scale_action(record["given"].astype(np.float32)[..., None])
    np.testing.assert_array_equal(again.replay_buffer.actions[:60][changed], executed[changed])
    copy = pickle.loads(pickle.dumps(model.replay_buffer))
    if make is filtered_goals:
        copy.set_env(again.get_env())
    for other in (again.replay_buffer, copy):
        np.testing.assert_array_equal(draw(other, 64), draw(model.replay_buffer, 64))
    if make is filtered_goals:
        with pytest.warns(UserWarning, match="last trajectory"):
            again.load_replay_buffer(tmp_path / "buffer")
    again.learn(20, reset_num_timesteps=False)
    assert again.replay_buffer.size() == 60 + 10
    if make is filtered_goals:  # the episode that the kill cut is whole now, and no one else's
        drawn = Goals(again.replay_buffer, 2000)
        np.testing.assert_allclose(drawn.reward, -np.abs(drawn.x_after - drawn.goal), atol=1e-4)
        last = again.replay_buffer.observations["observation"][59, :, 2]
        assert np.isin(last, drawn.number).all()


def test_what_is_stored_is_raw_and_what_is_drawn_is_normalised():
    model, record = learn(normalize=True, learning_starts=1000)
    buffer, envs, n = model.replay_buffer, model.get_vec_normalize_env(), len(record.steps)
    np.testing.assert_allclose(buffer.rewards[:n], record["paid"].astype(np.float32), atol=1e-6)
    raw, drawn = draw(buffer, 200), draw(buffer, 200, env=envs)
    scale = np.sqrt(envs.ret_rms.var + envs.epsilon)
    np.testing.assert_allclose(drawn[:, 6], np.clip(raw[:, 6] / scale, -10, 10), rtol=1e-5)
    centred = (raw[:, :2] - envs.obs_rms.mean) / np.sqrt(envs.obs_rms.var + envs.epsilon)
    np.testing.assert_allclose(drawn[:, :2], np.clip(centred, -10, 10), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(drawn[:, 2], raw[:, 2])


# Goals drawn in hindsight ----------------------------------------------------------------------------------------


class Goals:
    """A batch of transitions with goals, as the task's own numbers."""

    def __init__(self, buffer, count):
        np.random.seed(1)
        samples = buffer.sample(count)
        before, after = (
            {k: v.numpy() for k, v in part.items()}
            for part in (samples.observations, samples.next_observations)
        )
        self.x, _, self.number = before["observation"].T
        self.x_after = after["observation"][:, 0]
        self.goal, self.goal_after = before["desired_goal"].ravel(), after["desired_goal"].ravel()
        self.achieved = after["achieved_goal"].ravel()
        self.sent = -2.0 + (samples.actions.numpy().ravel() + 1.0) * 2.5  # unscaled
        self.reward, self.done = samples.rewards.numpy().ravel(), samples.dones.numpy().ravel()


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_every_transition_in_hindsight_is_the_executed_one(strategy):
    replay = {"goal_selection_strategy": strategy}
    model, _ = learn(
        filtered_goals,
        buffer=ExecutedActionHerReplayBuffer,
        learning_starts=1000,
        replay_buffer_kwargs=replay,
    )
    buffer = model.replay_buffer
    drawn = Goals(buffer, 1000)
    np.testing.assert_array_equal(drawn.goal, drawn.goal_after)
    np.testing.assert_array_equal(drawn.x_after, drawn.achieved)
    # Where the point went tells which action was executed: never the policy's where the wall stopped it.
    moved = (drawn.x_after - drawn.x) / HOLD
    np.testing.assert_allclose(drawn.sent, moved, atol=1e-4)
    stopped = np.abs(moved - (WALL - drawn.x) / HOLD) < 1e-4
    assert 50 < stopped.sum() < 950
    np.testing.assert_allclose(drawn.reward, -np.abs(drawn.x_after - drawn.goal), atol=1e-4)

    # Goals: of the first fifth the episode's own; of the others where the episode was, then or later.
    where = {}
    for env in range(buffer.n_envs):
        ends = np.flatnonzero(buffer.dones[: buffer.pos, env]) + 1
        for slots in np.split(np.arange(buffer.pos), ends)[: len(ends)]:
            reached = buffer.next_observations["achieved_goal"][slots, env, 0]
            for at, slot in enumerate(slots):
                number = buffer.observations["observation"][slot, env, 2]
                own = buffer.observations["desired_goal"][slot, env, 0]
                later = {"future": reached[at:], "final": reached[-1:], "episode": reached}[strategy]
                last = slot == slots[-1] and reached[-1] < -1.0  # the others are cut off by their length
                where[number] = (own, set(later), last)
    for at, number in enumerate(drawn.number):
        own, later, last = where[number]
        assert drawn.goal[at] == own if at < 200 else drawn.goal[at] in later
        assert drawn.done[at] == last


# One step, by hand ---------------------------------------------------------------------------------------------

SPACE = Box(np.array([-2.0, 0.0], np.float32), np.array([3.0, 10.0], np.float32))


def add(buffer, observation, after, action, reward, info):
    buffer.add(*(np.array([value]) for value in (observation, after, action, reward, False)), [info])


def info(proposed, executed):
    return {
        keys.PROPOSED_ACTION: np.array(proposed, np.float64),
        keys.EXECUTED_ACTION: np.array(executed, np.float64),
        keys.CBF_INTERVENED: proposed != executed,
    }


def test_an_action_that_is_not_finite_is_never_stored():
    # The first two are not; for the second one the filter chose just what stands for it in the infos.
    chosen = [[np.nan, 0.0], [0.0, np.inf], [0.0, 0.0]]
    infos = [info([0.0, 5.0], [1.0, 2.5]), info([0.5, 0.0], [0.5, 0.0]), info([0.5, 5.0], [0.5, 5.0])]
    buffer = ExecutedActionReplayBuffer(8, Box(-1.0, 1.0, (1,)), SPACE, device="cpu", n_envs=3)
    one = np.ones((3, 1))
    buffer.add(0.0 * one, one, np.array(chosen, np.float32), np.array([4.0, 5.0, 6.0]), np.zeros(3), infos)
    np.testing.assert_allclose(buffer.actions[0], [[0.2, -0.5], [0.0, -1.0], [0.0, 0.0]], atol=1e-6)
    np.testing.assert_array_equal(buffer.rewards[0], [4.0, 5.0, 6.0])


def test_of_a_repeated_action_what_its_last_control_step_executed_is_stored():
    env = sw.ActionRepeat(filtered(), 4)
    before, _ = env.reset(seed=0)
    after, reward, _, _, told = env.step(env.action_space.high)
    buffer = ExecutedActionReplayBuffer(8, env.observation_space, env.action_space, device="cpu")
    add(buffer, before, after, np.ones(1, np.float32), reward, told)  # the most that there is, to the right
    last, moved = told["truth"]["given"], float(after[0] - before[0])
    assert moved > 2.0 * HOLD * last  # the four were not the same
    assert buffer.actions[0, 0] == pytest.approx((last + 2.0) / 2.5 - 1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        ({"action_space": Discrete(3)}, "expected a bounded Box of actions, got Discrete"),
        ({"action_space": Box(-np.inf, 1.0, (1,))}, "expected a bounded Box of actions"),
        ({"observation_space": Dict({"x": Box(-1, 1, (1,))})}, "got Dict.*ExecutedActionDictReplayBuffer"),
    ],
)
def test_spaces_that_it_refuses(spaces, message):
    given = {"observation_space": Box(-1, 1, (1,)), "action_space": SPACE, **spaces}
    with pytest.raises(sw.SafeWrappersError, match=message):
        ExecutedActionReplayBuffer(8, **given)


FINE = info([0.5, 5.0], [0.5, 5.0])


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({}, "env 0 has no info.*needs a CBFActionFilter inside"),
        ({**FINE, keys.ADAPTION_PENALTY: 1.0}, "AdaptionPenalty, which would be charged"),
        (info([1.0, 5.0], [1.0, 5.0]), "the policy chose .* take that wrapper away"),
        ({**FINE, keys.EXECUTED_ACTION: np.zeros(3)}, r"has shape \(3,\), the action space \(2,\)"),
        ({**FINE, keys.EXECUTED_ACTION: np.array([np.nan, 0.0])}, "not finite"),
    ],
)
def test_steps_that_it_refuses(told, message):
    buffer = ExecutedActionReplayBuffer(8, Box(-1.0, 1.0, (1,)), SPACE, device="cpu")
    with pytest.raises(sw.SafeWrappersError, match=message):
        add(buffer, [0.0], [0.0], np.zeros(2, np.float32), 1.0, told)
    add(buffer, [0.0], [0.0], np.zeros(2, np.float32), 1.0, FINE)
    assert buffer.size() == 1
