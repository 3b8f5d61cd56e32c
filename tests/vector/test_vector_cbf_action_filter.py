"""VectorCBFActionFilter is a SyncVectorEnv of filtered envs: actions, observations, infos, in every autoreset mode.

The oracle is Gymnasium's own vector env around `CBFActionFilter`s.
"""

import copy
import dataclasses
import functools
import pickle
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_worlds import BEFORE_THE_WALL, AtHazard, ScheduledCart, cart_plant

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

pytestmark = [
    pytest.mark.filterwarnings("ignore:the policy's action:UserWarning"),
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
]
HORIZON, STEPS, ENVS = 9, 40, 3


def pair(make, limits, mode=AutoresetMode.NEXT_STEP, plant=None, **options):
    """The vector env of filters and the filter of a vector env, anew; `plant` makes another one than MuJoCo's."""

    def filtered(kind, env):
        return kind(env, limits, **({} if plant is None else {"plant": plant()}), **options)

    plain = SyncVectorEnv([make] * ENVS, autoreset_mode=mode)
    alike = [lambda: filtered(sw.CBFActionFilter, make())] * ENVS
    return SyncVectorEnv(alike, autoreset_mode=mode), filtered(sw.VectorCBFActionFilter, plain)


def on(env_id, inner=lambda env: env, changes=None):
    """`protect`'s constraints, the limit of a speed lower where random actions would not reach it."""
    limits = [dataclasses.replace(c, **(changes or {})) for c in sw.protect(gym.make(env_id)).constraints]
    return functools.partial(pair, lambda: inner(gym.make(env_id, max_episode_steps=HORIZON)), limits)


SHIELD = sw.constraints.PredictiveShield(
    lambda x: 2.0 - abs(x[2]), 5, backup=[lambda x: [-2.0 * np.sign(x[2])], "zero"], candidates=4
)
at_hazard = on("SafePointGoal1-v0", AtHazard)
reacher = on("Reacher-v5", changes={"limit": 1.0})
cart = functools.partial(pair, ScheduledCart, [BEFORE_THE_WALL], plant=cart_plant)
PLAYS = {
    "delay": functools.partial(at_hazard, plant=functools.partial(sw.MujocoPlant, delay_s=0.02)),
    "margin": functools.partial(at_hazard, margin=0.05),
    "hold": functools.partial(cart, fallback="hold"),
    "simulated": functools.partial(
        pair,
        lambda: gym.make("Pendulum-v1", max_episode_steps=HORIZON),
        [SHIELD],
        plant=functools.partial(sw.SimulatorPlant, check_steps=0),
    ),
    "Reacher, float16": reacher,
    "Reacher, list": reacher,
}
for mode in AutoresetMode:
    PLAYS[f"SafePointGoal1, {mode.value}"] = functools.partial(at_hazard, mode=mode)
    PLAYS[f"cart, {mode.value}"] = functools.partial(cart, mode=mode)
FORMS = {"Reacher, float16": np.float16, "Reacher, list": np.ndarray.tolist}
"""Of actions: the reward of Reacher has the action's dtype."""


def script(envs):
    """Bang-bang actions, held for a while, at times outside the box, once not finite."""
    rng, space = np.random.default_rng(0), envs.single_action_space
    for step in range(STEPS):
        if step % 6 == 0:
            held = rng.choice([-1.0, 1.0], (envs.num_envs, *space.shape))
        middle, half = 0.5 * (space.low + space.high), 0.5 * (space.high - space.low)
        actions = (middle + half * (held + 0.2 * rng.normal(size=held.shape))).astype(space.dtype)
        if step == 14:
            actions[0, 0] = np.nan
        yield actions


def assert_same(one, other, path=""):
    """Infos: the same keys, dtypes and values; norms may differ in their last digit."""
    assert set(one) == set(other), f"{path}: {set(one) ^ set(other)}"
    for key, value in one.items():
        if isinstance(value, dict):
            assert_same(value, other[key], f"{path}{key}/")
        elif key == "cbf/correction":
            np.testing.assert_allclose(value, other[key], rtol=1e-12, err_msg=path + key)
        elif value.dtype == object:
            assert all(np.array_equal(a, b) for a, b in zip(value, other[key], strict=True)), path + key
        else:
            assert value.dtype == other[key].dtype, path + key
            np.testing.assert_array_equal(value, other[key], err_msg=path + key)


def play(alike, together, actions):
    """Step both alike; how many steps were changed."""
    assert_same_start(alike.reset(seed=6), together.reset(seed=6))
    changed = 0
    for action in actions:
        results, others = alike.step(action), together.step(action)
        for result, other in zip(results[:4], others[:4], strict=True):
            np.testing.assert_equal(result, other)
        assert_same(results[4], others[4])
        finals = results[4].get("final_info", {}).get("cbf/intervened", False)
        changed += int(np.sum(results[4]["cbf/intervened"] | finals))
        ended = results[2] | results[3]
        if alike.autoreset_mode is AutoresetMode.DISABLED and ended.any():
            resets = (envs.reset(options={"reset_mask": ended.copy()}) for envs in (alike, together))
            assert_same_start(*resets)
    return changed


def assert_same_start(one, other):
    np.testing.assert_equal(one[0], other[0])
    assert_same(one[1], other[1])


@pytest.mark.parametrize("name", PLAYS)
def test_it_is_a_vector_env_of_filtered_envs(name):
    alike, together = PLAYS[name]()
    assert play(alike, together, map(FORMS.get(name, np.asarray), script(alike))) > 3
    assert [one.filter_calls for one in together.filters] == [one.filter_calls for one in alike.envs]


@pytest.mark.parametrize("again", [copy.deepcopy, lambda envs: pickle.loads(pickle.dumps(envs))])
def test_a_copy_has_the_same_episodes(again):
    alike, used = pair(functools.partial(gym.make, "Reacher-v5"), [sw.constraints.JointSpeedLimit(1.0)])
    assert play(alike, used, script(used)) > 3
    play(alike, again(used), script(used))


def test_actions_of_another_shape_and_other_vector_envs_are_refused():
    envs = sw.protect(gym.make_vec("SafePointGoal1-v0", 2, vectorization_mode="sync"))
    envs.reset(seed=0)
    for wrong in (np.zeros(2), np.zeros((3, 2)), [[0.1], [0.1, 0.2]], "fast", None, np.ma.masked_all((2, 2))):
        with pytest.raises(sw.SafeWrappersError, match="expected an action of shape"):
            envs.step(wrong)
    with pytest.raises(sw.SafeWrappersError, match="VectorCBFActionFilter inside the filter"):
        sw.protect(envs)
    scaled = gym.wrappers.vector.ClipAction(gym.make_vec("SafePointGoal1-v0", 2, vectorization_mode="sync"))
    with pytest.raises(sw.SafeWrappersError, match="ClipAction inside the filter changes the actions"):
        sw.protect(scaled)


def test_it_goes_around_vector_wrappers_and_warns_once_and_not_once_for_every_env():
    plain = gym.make_vec("SafePointGoal1-v0", 3, vectorization_mode="sync")
    envs = sw.protect(gym.wrappers.vector.RecordEpisodeStatistics(plain))
    assert isinstance(envs, sw.VectorCBFActionFilter)
    envs.reset(seed=0)
    with pytest.warns(UserWarning, match="not finite") as said:
        assert envs.step(np.full((3, 2), np.nan, np.float32))[4]["cbf/nonfinite"].all()
    assert len(said) == 1


def test_before_a_reset_and_after_one_that_an_env_refuses_no_step_is_made():
    envs = sw.VectorCBFActionFilter(
        gym.make_vec("Reacher-v5", num_envs=2, vectorization_mode="sync"),
        [sw.constraints.JointSpeedLimit(limit=4.0)],
    )
    actions = np.zeros((2, 2), dtype=np.float32)
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(actions)
    envs.reset(seed=0)
    envs.step(actions)
    refuses = mock.patch.object(
        envs.filters[1].filter.bound[0], "observe", side_effect=ConfigurationError("no")
    )
    with refuses, pytest.raises(ConfigurationError):
        envs.reset(seed=0)
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(actions)
    envs.reset(seed=0)
    envs.step(actions)
