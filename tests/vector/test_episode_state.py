"""What the filter and the recorder keep of an episode is gone at the next one's first step, and not before."""

import functools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_worlds import CountUnsafeWarnings, cart, cart_filter, slow, sub_envs

import safe_wrappers as sw

NEXT, SAME, OFF = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
ENDS = {"ends": [[2], [4], [4]]}
pytestmark = pytest.mark.filterwarnings("ignore:the policy's action is not finite:UserWarning")
every_mode = pytest.mark.parametrize("mode", [NEXT, SAME, OFF], ids=lambda mode: mode.value)


def carts(mode, make=cart_filter, **options):
    """Three carts of which the first one's episode ends after two steps."""
    envs = SyncVectorEnv(sub_envs(make), autoreset_mode=mode)
    envs.reset(seed=0, options={**ENDS, "start": [-1.0, 0.0], **options})
    return envs


def said(*actions):
    return np.array(actions, np.float32)[:, None]


def restart(envs, ended=(True, False, False)):
    """To the first sub-env's new episode, as its mode has it; an action that is ignored is the worst there is."""
    if envs.metadata["autoreset_mode"] is NEXT:
        envs.step(said(np.nan, 0.0, 0.0))
    elif envs.metadata["autoreset_mode"] is OFF:
        envs.reset(options={"reset_mask": np.array(ended)})


@every_mode
def test_the_last_action_is_held_within_an_episode_and_not_beyond(mode):
    envs = carts(mode)
    envs.step(said(0.5, 0.5, 0.5))
    infos = envs.step(said(np.nan, np.nan, 0.5))[4]
    ending = infos["final_info"] if mode is SAME else infos
    assert ending["executed_action"][0] == 0.5
    assert infos["executed_action"][1] == 0.5
    restart(envs)
    infos = envs.step(said(np.nan, 0.0, 0.0))[4]
    assert infos["cbf/nonfinite"].tolist() == [True, False, False]
    assert infos["executed_action"][0] == 0.0


class StartAt(gym.Wrapper):
    """Every episode starts at rest at x, behind the wall or not."""

    def __init__(self, env, x):
        super().__init__(env)
        self.x = x

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed, options={**(options or {}), "start": [self.x, 0.0]})


def starting_at(x, index=0, delay_s=0.0):
    return CountUnsafeWarnings(StartAt(cart_filter(index, delay_s), x))


@every_mode
def test_commands_in_flight_do_not_fly_into_the_next_episode(mode):
    # cbf/margin is that of the state predicted over the delay. Far from the wall it is what is left of the speed
    # limit: all of it for a cart at rest with nothing in flight, less with pushes left over.
    still = slow([-1.0, 0.0])
    envs = SyncVectorEnv([functools.partial(starting_at, -1.0, delay_s=0.25)], autoreset_mode=mode)
    _, infos = envs.reset(seed=0, options={"ends": [[2, 2]]})
    assert infos["cbf/margin"] == still
    envs.step(said(1.0))
    infos = envs.step(said(1.0))[4]
    before = infos["final_info"] if mode is SAME else infos
    assert before["cbf/margin"] < still - 0.01  # in flight, so the test can tell
    if mode is NEXT:
        infos = envs.step(said(1.0))[4]
    elif mode is OFF:
        _, infos = envs.reset(options={"reset_mask": np.array([True])})
    assert infos["cbf/margin"] == still  # the reset's own
    assert envs.step(said(0.0))[4]["cbf/margin"] == still


def test_the_action_that_only_resets_is_neither_filtered_nor_counted():
    envs = carts(NEXT, lambda index: sw.RecordInterventions(cart_filter(index)))
    with warnings.catch_warnings(action="error"):
        for _ in range(2):
            envs.step(said(0.5, 0.5, 0.5))
        envs.step(said(np.nan, 0.5, 0.5))
    assert envs.get_attr("filter_calls") == (2, 3, 3)
    with pytest.warns(UserWarning, match="not finite"):
        infos = envs.step(said(np.nan, 0.5, 0.5))[4]
    assert envs.get_attr("filter_calls") == (3, 4, 4)
    # One step into the new episode: the recorder has seen one, and only the first sub-env's was not finite.
    assert infos["cbf/fallback"].tolist() == [True, False, False]
    assert infos["_interventions"].tolist() == [False, True, True]
    assert infos["interventions"]["length"].tolist() == [0, 4, 4]


def test_a_partial_reset_resets_no_other():
    envs = carts(OFF, cart)
    envs.step(said(0.5, -0.5, 0.25))
    envs.step(said(0.5, -0.5, np.nan))
    options = {"reset_mask": np.array([True, False, False])}
    observations, infos = envs.reset(options=options)
    assert options == {}  # Gymnasium takes the mask out before our wrappers see the options
    assert all(mask.tolist() == [True, False, False] for key, mask in infos.items() if key[0] == "_")
    assert observations[0].tobytes() == infos["start"][0].tobytes()
    infos = envs.step(said(np.nan, np.nan, np.nan))[4]
    assert infos["executed_action"][:, 0].tolist() == [0.0, -0.5, 0.25]
    assert infos["cbf/fallback"].all()
    assert infos["count"].tolist() == [1, 3, 3]
    assert envs.get_attr("filter_calls") == (3, 3, 3)


@every_mode
def test_an_unsafe_start_is_warned_of_once_in_its_episode_and_its_sub_env(mode):
    starts = enumerate((1.5, -1.0, 1.5))
    envs = SyncVectorEnv([functools.partial(starting_at, x, i) for i, x in starts], autoreset_mode=mode)
    envs.reset(seed=0, options={"ends": [[3, 3]] * 3})
    for _ in range(2):
        for t in range(3):
            infos = envs.step(said(0.0, 0.0, 0.0))[4]
            seen = infos["final_info"] if mode is SAME and t == 2 else infos
            assert seen["cbf/unsafe"].tolist() == [True, False, True]
            assert seen["unsafe_warnings"].tolist() == [1, 0, 1]
        restart(envs, (True, True, True))
