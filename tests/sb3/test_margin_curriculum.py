"""MarginCurriculum: the margin of a filter in training, and what a filter with another margin decides."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import MarginCurriculum

FRACTION = st.floats(0.0, 1.0)


def reacher(margin=0.0):
    return sw.protect(gym.make("Reacher-v5"), margin=margin)


def learner(env, **more):
    return PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, device="cpu", **more)


class Margins(BaseCallback):
    """What the filters had at every step."""

    def _on_training_start(self):
        self.seen = []

    def _on_step(self):
        self.seen.append(self.training_env.get_attr("added_margin")[0])
        return True


@given(st.floats(0.0, 2.0), st.floats(0.0, 2.0), st.floats(0.01, 1.0), FRACTION)
def test_the_margin_is_linear_until_its_share_and_constant_from_there(start, end, until, share):
    margin = MarginCurriculum(start, end, until).margin(share)
    line = np.interp(share, [0.0, until], [start, end])
    assert abs(margin - line) <= 0.01 * abs(start - end) + 1e-9
    assert min(start, end) - 1e-12 <= margin <= max(start, end) + 1e-12
    if share >= until:
        assert margin == end


@pytest.mark.parametrize("wrong", [{"start": -0.1}, {"start": 0.1, "end": -0.1}, {"start": 1, "until": 1.5}])
def test_a_margin_below_the_recipe_s_own_and_a_wrong_share_are_refused(wrong):
    with pytest.raises(ConfigurationError):
        MarginCurriculum(**wrong)


def test_a_training_sees_the_margins_from_the_first_step_on():
    margins = Margins()
    learner(reacher()).learn(128, callback=[MarginCurriculum(1.0, 0.0, 0.5), margins])
    assert margins.seen == [1.0] * 32 + [0.5] * 32 + [0.0] * 64


def test_a_training_that_goes_on_has_the_margin_of_where_it_stands(tmp_path):
    curriculum, margins = MarginCurriculum(1.0, 0.0), Margins()
    whole = learner(reacher())
    whole.learn(128, callback=[curriculum, margins])
    half = learner(reacher())
    half.learn(32)
    half.save(tmp_path / "half")
    rest = Margins()
    PPO.load(tmp_path / "half", env=reacher()).learn(
        96, callback=[MarginCurriculum(1.0, 0.0), rest], reset_num_timesteps=False
    )
    assert margins.seen[32:] == rest.seen == [0.75] * 32 + [0.5] * 32 + [0.25] * 32


def trace(env, steps, change=None, at=0, seed=3):
    """What is executed for random full throttle; the margin changes before one step."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    executed = []
    for step in range(steps):
        if change is not None and step == at:
            env.set_margin(change)
        action = rng.choice([-1.0, 1.0], env.action_space.shape).astype(env.action_space.dtype)
        executed.append(env.step(action)[4]["executed_action"])
    return np.array(executed)


@pytest.mark.parametrize(
    ("name", "margin"),
    [
        ("SafePointGoal1-v0", 0.1),
        ("SafeCarGoal1-v0", 0.1),
        ("Reacher-v5", 1.0),
        ("SafeHalfCheetahVelocity-v0", 1.5),
        ("PointMaze_UMaze-v3", 0.05),
        ("InvertedPendulum-v5", 0.3),
        ("SafeRover-v0", 0.1),
    ],
)
def test_a_filter_whose_margin_is_set_decides_as_one_that_was_made_with_it(name, margin):
    if "Maze" in name:
        gym.register_envs(pytest.importorskip("gymnasium_robotics"))

    def make(margin=0.0):
        return sw.protect(gym.make(name, max_episode_steps=500), margin=margin)

    made, changed = make(margin), make()
    steps = 200 if name != "SafeHalfCheetahVelocity-v0" else 60
    changed.reset(seed=0)
    changed.set_margin(margin)
    assert changed.added_margin == margin
    wide = trace(made, steps)
    assert np.array_equal(trace(changed, steps), wide)
    # And back: what was set leaves nothing behind.
    changed.set_margin(0.0)
    assert np.array_equal(trace(changed, steps), trace(make(), steps))


def test_a_margin_that_changes_in_an_episode_acts_from_the_next_step_on():
    plain, wide = trace(reacher(), 40), trace(reacher(), 40, change=4.5, at=20)
    assert np.array_equal(plain[:20], wide[:20])
    env = reacher()
    trace(env, 40, change=4.5, at=20)
    # The recipe keeps 5 rad/s with 0.01 in reserve: 0.49 rad/s are left after a while.
    assert not np.array_equal(plain[20:], wide[20:])
    for _ in range(30):
        env.step(env.action_space.high)
    assert np.abs(env.unwrapped.data.qvel[:2]).max() <= 0.49 + 1e-6


def test_what_constraints_remember_of_the_episode_stays():
    env = reacher()
    trace(env, 5)
    memory, last = list(env.filter.memories), env.filter.last.copy()
    env.set_margin(0.5)
    assert env.filter.memories == memory and np.array_equal(env.filter.last, last)


def test_a_margin_that_leaves_nothing_is_refused_and_the_old_one_stays():
    env = reacher(0.25)
    before = env.filter
    for wrong in (-1.0, np.nan, 6.0):
        with pytest.raises(ConfigurationError):
            env.set_margin(wrong)
    assert env.added_margin == 0.25 and env.filter is before
    assert env.constraints[0].margin == pytest.approx(0.26)
