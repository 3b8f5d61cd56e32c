"""The buffer against a record that the env and a callback keep, not the buffer."""

import functools
import pickle

import gymnasium as gym
import line_world
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from line_world import HOLD, WALL, filtered
from scipy import stats
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.sb3 import ExecutedActionDictReplayBuffer, ExecutedActionReplayBuffer

torch.set_num_threads(1)


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
                "observed": np.array(self.model._last_obs),
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


def learn(n_envs=1, steps=120, algorithm=SAC, vec_env=DummyVecEnv, make=filtered, **settings):
    """A trained model with the buffer under test, and the record of its steps."""
    envs = vec_env([make] * n_envs)
    noise = None if algorithm is SAC else NormalActionNoise(np.zeros(1), 0.6 * np.ones(1))
    settings = {
        "buffer_size": 1000,
        "learning_starts": 60,
        "batch_size": 16,
        "action_noise": noise,
        "replay_buffer_class": ExecutedActionReplayBuffer,
        "policy_kwargs": {"net_arch": [8]},
        "policy": "MlpPolicy",
        "seed": 0,
        "device": "cpu",
        **settings,
    }
    model = algorithm(env=envs, **settings)
    record = Record()
    model.learn(steps, callback=record)
    envs.close()
    return model, record


def check(model, record):
    """The buffer, slot by slot, is what the record and the closed-form filter say; returns its transitions."""
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
    ends = (record["done"] & ~record["cut"]).astype(np.float32)
    columns = (record["observed"], same["actions"], record["after"], ends[..., None], task[..., None])
    return np.concatenate(columns, axis=-1, dtype=np.float32).reshape(-1, 7)


def rows(samples):
    """Observation, action, next observation, done, reward; the sixth part is for n-step returns."""
    return np.concatenate([part.numpy() for part in samples[:5]], axis=1)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_sac_stores_what_was_executed(n_envs):
    model, record = learn(n_envs)
    check(model, record)
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())


def test_batches_are_drawn_uniformly_from_all_transitions():
    model, record = learn(n_envs=2, steps=120)
    # Two steps along the wall can be the same transition.
    known, times = np.unique(check(model, record), axis=0, return_counts=True)
    np.random.seed(0)
    drawn = rows(model.replay_buffer.sample(100 * len(known)))
    # Every draw is one of the record's transitions, whole.
    index = {row.tobytes(): at for at, row in enumerate(known)}
    counts = np.bincount([index[row.tobytes()] for row in drawn], minlength=len(known))
    assert stats.chisquare(counts, times * len(drawn) / times.sum()).pvalue > 1e-3


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_full_buffer_forgets_its_oldest_steps_and_only_those(n_envs):
    model, record = learn(n_envs, steps=240, buffer_size=60, learning_starts=1000)
    buffer, kept = model.replay_buffer, 60 // n_envs
    assert buffer.full and buffer.size() == kept
    fresh, tail = learn(n_envs, steps=240, learning_starts=1000)
    for name in ("actions", "rewards", "observations"):
        theirs = getattr(fresh.replay_buffer, name)[: len(tail.steps)][-kept:]
        mine = np.roll(getattr(buffer, name), -buffer.pos, axis=0)
        np.testing.assert_array_equal(mine, theirs, err_msg=name)
    assert rows(buffer.sample(500)).shape == (500, 7)
    np.testing.assert_array_equal(record["paid"], tail["paid"])


def test_an_inactive_filter_changes_nothing_of_the_learning():
    far = functools.partial(filtered, wall=100.0)
    ours, record = learn(make=far)
    assert (record["given"] == record["sent"][..., 0]).all()
    theirs, _ = learn(make=far, replay_buffer_class=None)
    assert type(theirs.replay_buffer) is ReplayBuffer
    for mine, other in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert torch.equal(mine, other)
    n = len(record.steps)
    np.testing.assert_array_equal(ours.replay_buffer.actions[:n], theirs.replay_buffer.actions[:n])


def test_saving_and_loading(tmp_path):
    model, record = learn(n_envs=2)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    again = SAC.load(tmp_path / "model", env=DummyVecEnv([filtered] * 2), device="cpu")
    assert type(again.replay_buffer) is ExecutedActionReplayBuffer and again.replay_buffer.size() == 0
    again.load_replay_buffer(tmp_path / "buffer")
    check(again, record)
    copy = pickle.loads(pickle.dumps(model.replay_buffer))
    np.random.seed(3)
    first = rows(again.replay_buffer.sample(64))
    np.random.seed(3)
    np.testing.assert_array_equal(rows(copy.sample(64)), first)
    before = again.replay_buffer.size()
    again.learn(20, reset_num_timesteps=False)
    assert again.replay_buffer.size() == before + 10


def test_dict_observations():
    model, record = learn(
        n_envs=2,
        make=line_world.filtered_dict,
        policy="MultiInputPolicy",
        replay_buffer_class=ExecutedActionDictReplayBuffer,
    )
    flat, same = learn(n_envs=2)
    n = 60 // 2  # from there on the networks differ
    buffer, plain = model.replay_buffer, flat.replay_buffer
    np.testing.assert_array_equal(record["paid"][:n], same["paid"][:n])
    for name in ("actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(buffer, name)[:n], getattr(plain, name)[:n], err_msg=name)
    for part, at in (("x", 0), ("steps", 1)):
        np.testing.assert_array_equal(buffer.observations[part][:n, :, 0], plain.observations[:n, :, at])
        np.testing.assert_array_equal(
            buffer.next_observations[part][:n, :, 0], plain.next_observations[:n, :, at]
        )
    batch = buffer.sample(32)
    known = buffer.observations["x"].ravel()
    assert set(batch.observations["x"].numpy().ravel()) <= set(known)
    assert batch.actions.shape == batch.rewards.shape == batch.dones.shape == (32, 1)


def test_what_is_stored_is_raw_and_what_is_drawn_is_normalised():
    envs = VecNormalize(DummyVecEnv([filtered] * 2))
    model = SAC(
        "MlpPolicy",
        envs,
        buffer_size=400,
        learning_starts=1000,
        replay_buffer_class=ExecutedActionReplayBuffer,
        seed=0,
        device="cpu",
    )
    record = Record()
    model.learn(120, callback=record)
    n = len(record.steps)
    np.testing.assert_allclose(model.replay_buffer.rewards[:n], record["paid"].astype(np.float32), atol=1e-6)
    np.random.seed(1)
    raw = model.replay_buffer.sample(200)
    np.random.seed(1)
    drawn = model.replay_buffer.sample(200, env=model.get_vec_normalize_env())
    scale = np.sqrt(envs.ret_rms.var + envs.epsilon)
    np.testing.assert_allclose(drawn.rewards, np.clip(raw.rewards.numpy() / scale, -10, 10), rtol=1e-5)
    centred = (raw.observations.numpy() - envs.obs_rms.mean) / np.sqrt(envs.obs_rms.var + envs.epsilon)
    np.testing.assert_allclose(drawn.observations, np.clip(centred, -10, 10), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(drawn.actions, raw.actions)


# One step, by hand ---------------------------------------------------------------------------------------------

SPACE = Box(np.array([-2.0, 0.0], np.float32), np.array([3.0, 10.0], np.float32))


def info(proposed, executed):
    return {
        keys.PROPOSED_ACTION: np.array(proposed, np.float64),
        keys.EXECUTED_ACTION: np.array(executed, np.float64),
        keys.CBF_INTERVENED: proposed != executed,
    }


def test_an_action_that_is_not_finite_is_never_stored():
    # The first two are not; for the second one the filter chose just what stands for it in the infos.
    chosen = [[np.nan, 0.0], [0.0, np.inf], [0.0, 0.0]]
    infos = [
        info([0.0, 5.0], [1.0, 2.5]),
        info([0.5, 0.0], [0.5, 0.0]),
        info([0.5, 5.0], [0.5, 5.0]),
    ]
    buffer = ExecutedActionReplayBuffer(8, Box(-1.0, 1.0, (1,)), SPACE, device="cpu", n_envs=3)
    one = np.ones((3, 1))
    buffer.add(0.0 * one, one, np.array(chosen, np.float32), np.array([4.0, 5.0, 6.0]), np.zeros(3), infos)
    np.testing.assert_allclose(buffer.actions[0], [[0.2, -0.5], [0.0, -1.0], [0.0, 0.0]], atol=1e-6)
    np.testing.assert_array_equal(buffer.rewards[0], [4.0, 5.0, 6.0])


def test_what_an_escape_executed_is_stored_in_place_of_the_policys_action():
    env = sw.protect(gym.make("SafePointGoal1-v0"), detour=False)
    env = sw.StuckEscape(env, after_s=0.5, progress=0.05, escape_s=0.5)
    layout = {"agent": [0, 0, 0], "hazards": [[0.5, 0.0]], "goal": [1.3, 0.0]}
    observation, _ = env.reset(seed=0, options={"layout": layout})
    buffer = ExecutedActionReplayBuffer(200, env.observation_space, env.action_space, device="cpu")
    push, executed, replaced = np.array([1.0, 0.0], np.float32), [], []
    for _ in range(200):
        following, reward, _, _, info = env.step(push)
        arguments = (np.array([value]) for value in (observation, following, push, reward, False))
        buffer.add(*arguments, [info])
        executed.append(info[keys.EXECUTED_ACTION])
        replaced.append(info["cbf/escaping"] and not info[keys.CBF_INTERVENED])
        observation = following
    assert sum(replaced) > 10
    np.testing.assert_allclose(buffer.actions[:, 0], executed, atol=1e-6)


def test_of_a_repeated_action_what_its_last_control_step_executed_is_stored():
    env = sw.ActionRepeat(filtered(), 4)
    before, _ = env.reset(seed=0)
    action = np.array([1.0], np.float32)  # the most that there is, to the right
    after, reward, _, _, info = env.step(env.action_space.high)
    buffer = ExecutedActionReplayBuffer(8, env.observation_space, env.action_space, device="cpu")
    buffer.add(*(np.array([value]) for value in (before, after, action, reward, False)), [info])
    last, moved = info["truth"]["given"], float(after[0] - before[0])
    assert moved > 2.0 * HOLD * last  # the four were not the same
    assert buffer.actions[0, 0] == pytest.approx((last + 2.0) / 2.5 - 1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"action_space": Discrete(3)}, "expected a bounded Box of actions, got Discrete"),
        ({"action_space": Box(-np.inf, 1.0, (1,))}, "expected a bounded Box of actions"),
        ({"observation_space": Dict({"x": Box(-1, 1, (1,))})}, "got Dict.*ExecutedActionDictReplayBuffer"),
    ],
)
def test_what_it_refuses(arguments, message):
    given = {"observation_space": Box(-1, 1, (1,)), "action_space": SPACE, **arguments}
    with pytest.raises(sw.SafeWrappersError, match=message):
        ExecutedActionReplayBuffer(8, **given)
