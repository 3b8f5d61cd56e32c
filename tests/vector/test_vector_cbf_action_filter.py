"""VectorCBFActionFilter is a SyncVectorEnv of filtered envs: actions, observations, infos, in every autoreset mode.

The oracle is Gymnasium's own vector env around `CBFActionFilter`s.
"""

import copy
import dataclasses
import functools
from unittest import mock

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_worlds import AtHazard, ScheduledCart, drift, push, read, slow

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.faults import Outages

gym.register_envs(gymnasium_robotics)
pytestmark = [
    pytest.mark.filterwarnings("ignore:the policy's action:UserWarning"),
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
]
every_mode = pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
HORIZON, STEPS, ENVS = 9, 24, 3


def made(env_id, inner=lambda env: env):
    return inner(gym.make(env_id, max_episode_steps=HORIZON))


def recommended(env_id, **changes):
    """`protect`'s constraints, the limit of a speed lower where random actions would not reach it."""
    return [dataclasses.replace(c, **changes) for c in sw.protect(gym.make(env_id)).constraints]


TABLE = {
    "SafePointGoal1-v0": ({}, AtHazard),
    "SafePointGoal2-v0": ({"detour": False}, AtHazard),
    "SafeCarGoal1-v0": ({}, AtHazard),
    "InvertedPendulum-v5": ({"margin": 0.85}, None),
    "Reacher-v5": ({"limit": 1.0}, None),
    "PointMaze_UMaze-v3": ({"margin": 0.25}, None),
    "SafeHalfCheetahVelocity-v0": ({"limit": 0.2}, None),
    "SafeAntVelocity-v0": ({"limit": 0.4}, None),
    "SafeHopperVelocity-v0": ({"limit": 0.1}, None),
    "SafeSwimmerVelocity-v0": ({"limit": 0.05}, None),
    "SafeHumanoidVelocity-v0": ({"limit": 0.03}, None),
    "FetchReach-v4": ({}, None),
}
"""Env id -> changes of the recipe; a wrapper that starts where the filter is needed."""


def pair(make, constraints, mode=AutoresetMode.NEXT_STEP, envs=ENVS, **options):
    """The vector env of filters, and the filter of a vector env."""

    def filtered():
        return sw.CBFActionFilter(
            make(), constraints, **{k: v() if k == "plant" else v for k, v in options.items()}
        )

    plain = SyncVectorEnv([make] * envs, autoreset_mode=mode)
    given = {k: v() if k == "plant" else v for k, v in options.items()}
    return SyncVectorEnv([filtered] * envs, autoreset_mode=mode), sw.VectorCBFActionFilter(
        plain, constraints, **given
    )


def script(envs, steps=STEPS, seed=0):
    """Bang-bang actions, held for a while, at times outside the box, once not finite."""
    rng, space = np.random.default_rng(seed), envs.single_action_space
    for step in range(steps):
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


def play(alike, together, actions, seed=6):
    """Step both alike; how many steps were changed."""
    if seed is not None:
        assert_same_start(alike.reset(seed=seed), together.reset(seed=seed))
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


@pytest.mark.parametrize("env_id", TABLE)
def test_it_is_a_vector_env_of_filtered_envs(env_id):
    changes, inner = TABLE[env_id]
    alike, together = pair(
        functools.partial(made, env_id, inner or (lambda env: env)), recommended(env_id, **changes)
    )
    assert play(alike, together, script(alike)) > 3
    assert [single.filter_calls for single in together.filters] == [
        single.filter_calls for single in alike.envs
    ]


@every_mode
@pytest.mark.parametrize("env_id", ["SafePointGoal1-v0", "Reacher-v5"])
def test_in_every_autoreset_mode(env_id, mode):
    changes, inner = TABLE[env_id]
    make = functools.partial(made, env_id, inner or (lambda env: env))
    alike, together = pair(make, recommended(env_id, **changes), mode)
    assert play(alike, together, script(alike, 40)) > 3


@every_mode
@pytest.mark.parametrize("fallback", ["hold", "brake"])
def test_without_mujoco_and_with_a_fallback_that_holds(mode, fallback):
    wall = sw.constraints.Clearance(
        [sw.constraints.Plane([1.0], [-1.0])], braking=1.0, position=[0], velocity=[1]
    )
    plant = functools.partial(sw.AnalyticPlant, f=drift, g=push, state=read, control_dt=0.1)
    alike, together = pair(ScheduledCart, [wall], mode, plant=plant, fallback=fallback)
    assert play(alike, together, script(alike, 40)) > 3


@pytest.mark.parametrize("seed", range(3))
def test_long_episodes_among_the_hazards_with_detours_and_other_precisions(seed):
    def make():
        return AtHazard(gym.make("SafePointGoal1-v0"))

    alike, together = pair(make, recommended("SafePointGoal1-v0"), envs=4)
    rng = np.random.default_rng(seed)
    actions = np.repeat(rng.uniform(-1.0, 1.0, (10, 4, 2)), 25, axis=0)
    actions[..., 0] = 1.0
    assert play(alike, together, actions.astype(np.float32 if seed else np.float64), seed) > 30


@pytest.mark.parametrize(
    "form", [np.ndarray.tolist, np.float64, np.float16], ids=["list", "float64", "float16"]
)
@pytest.mark.parametrize("env_id", ["SafePointGoal1-v0", "Reacher-v5"])
def test_what_is_written_has_the_dtype_of_the_space_in_which_an_env_may_compute(env_id, form):
    changes, inner = TABLE[env_id]
    make = functools.partial(made, env_id, inner or (lambda env: env))
    alike, together = pair(make, recommended(env_id, **changes))
    assert (
        play(alike, together, map(form, script(alike, 40))) > 3
    )  # the reward of Reacher has the action's dtype


@pytest.mark.parametrize("options", [{"plant": lambda: sw.MujocoPlant(delay_s=0.02)}, {"margin": 0.05}])
def test_with_a_delay_or_a_margin(options):
    make = functools.partial(made, "SafePointGoal1-v0", AtHazard)
    alike, together = pair(make, recommended("SafePointGoal1-v0"), **options)
    assert play(alike, together, script(alike)) > 3


def test_what_changes_during_an_episode_is_read_again():
    make = functools.partial(made, "SafePointGoal1-v0", AtHazard)
    alike, together = pair(make, recommended("SafePointGoal1-v0"))
    play(alike, together, script(alike))
    for single in (*alike.envs, *together.filters):
        single.plant.perturb(mass=1.5, damping=0.7)
    play(alike, together, script(alike, 4, seed=1), seed=None)
    for envs in (alike.envs, together.env.envs):
        raw = envs[1].unwrapped
        raw._hazards = raw._hazards[1:]
    play(alike, together, script(alike, seed=2), seed=None)


def test_after_a_reset_nothing_is_left_of_the_last_episode():
    make = functools.partial(made, "SafePointGoal1-v0", AtHazard)
    alike, together = pair(make, recommended("SafePointGoal1-v0"), fallback="hold")
    forward = np.ones((1, ENVS, 2), np.float32)
    play(
        alike, together, forward.repeat(HORIZON, axis=0)
    )  # to the end of the episode, before the reset that follows
    play(alike, together, forward * np.nan)  # held: nothing yet in the new episode
    play(alike, together, forward.repeat(3, axis=0))
    play(alike, together, forward * np.nan, seed=None)  # held: the last action


def test_a_copy_plays_alike_and_leaves_the_original_alone():
    alike, together = pair(
        functools.partial(made, "SafePointGoal1-v0", AtHazard), recommended("SafePointGoal1-v0")
    )
    play(alike, together, script(alike, 4))
    copied = copy.deepcopy(together)  # Gymnasium's envs are made anew
    there = [env.unwrapped.data.qpos.copy() for env in together.env.envs]
    assert play(alike, copied, script(alike)) > 3
    np.testing.assert_equal([env.unwrapped.data.qpos for env in together.env.envs], there)


def test_a_state_that_is_not_a_number_runs_the_fallback_and_a_start_outside_is_warned_of():
    make = functools.partial(made, "SafePointGoal1-v0", AtHazard)
    alike, together = pair(make, recommended("SafePointGoal1-v0"))
    play(alike, together, script(alike, 4))
    infos = []
    for envs in (alike.envs, together.env.envs):
        envs[0].unwrapped.data.qpos[0] = np.nan
        hazard = envs[1].unwrapped.hazard_positions[0]
        envs[1].unwrapped.data.qpos[:2] = hazard
    with pytest.warns(sw.UnsafeStateWarning):
        infos = [envs.step(np.ones((3, 2), np.float32))[4] for envs in (alike, together)]
    assert infos[1]["cbf/fallback"][0] and infos[1]["cbf/unsafe"][:2].all()
    assert_same(*infos)


def test_actions_of_another_shape_and_other_vector_envs_are_refused():
    envs = sw.protect(gym.make_vec("SafePointGoal1-v0", 2, vectorization_mode="sync"))
    envs.reset(seed=0)
    with pytest.raises(sw.SafeWrappersError, match=r"expected an action of shape \(2, 2\), got shape \(2,\)"):
        envs.step(np.zeros(2))
    with pytest.raises(sw.SafeWrappersError, match="VectorCBFActionFilter inside the filter"):
        sw.protect(envs)
    scaled = gym.wrappers.vector.ClipAction(gym.make_vec("SafePointGoal1-v0", 2, vectorization_mode="sync"))
    with pytest.raises(sw.SafeWrappersError, match="ClipAction inside the filter changes the actions"):
        sw.protect(scaled)
    faulty = SyncVectorEnv([lambda: Outages(gym.make("SafePointGoal1-v0"), 0.1, 0.1)])
    with pytest.raises(sw.SafeWrappersError, match="Outages inside CBFActionFilter"):
        sw.VectorCBFActionFilter(faulty, recommended("SafePointGoal1-v0"))


def test_the_last_step_of_an_episode_is_reported_beside_envs_that_go_on():
    # SB3's adapter asks for SAME_STEP: there a buffer of executed actions reads final_info.
    makers = [functools.partial(ScheduledCart, index) for index in range(2)]
    limit = [sw.constraints.Barrier(slow)]
    plant = functools.partial(sw.AnalyticPlant, drift, push, read)
    filtered = [lambda make=make: sw.CBFActionFilter(make(), limit, plant()) for make in makers]
    same = AutoresetMode.SAME_STEP
    alike = SyncVectorEnv(filtered, autoreset_mode=same)
    together = sw.VectorCBFActionFilter(SyncVectorEnv(makers, autoreset_mode=same), limit, plant())
    start = {"start": [0.0, 0.45], "ends": [[3], [100]]}
    for envs in (alike, together):
        envs.reset(seed=0, options=start)
    for _ in range(3):
        infos, others = (envs.step(np.ones((2, 1), np.float32))[4] for envs in (alike, together))
    finals = others["final_info"]
    np.testing.assert_array_equal(finals["_executed_action"], [True, False])
    assert finals["cbf/intervened"][0] and finals["executed_action"][0] != 0.0
    assert_same(infos, others)


def test_after_a_reset_that_one_env_refuses_no_step_is_made():
    envs = sw.VectorCBFActionFilter(
        gym.make_vec("Reacher-v5", num_envs=2, vectorization_mode="sync"),
        [sw.constraints.JointSpeedLimit(limit=4.0)],
    )
    envs.reset(seed=0)
    actions = np.zeros((2, 2), dtype=np.float32)
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


def test_a_step_that_one_env_breaks_off_admits_nothing_of_the_next():
    envs = sw.VectorCBFActionFilter(
        SyncVectorEnv([lambda: gym.make("SafePointGoal1-v0")] * 2), recommended("SafePointGoal1-v0")
    )
    envs.reset(seed=0)
    actions = np.zeros((2, 2), dtype=np.float32)
    with (
        mock.patch.object(envs.filters[0].env, "step", side_effect=RuntimeError("the env's own")),
        pytest.raises(RuntimeError),
    ):
        envs.step(actions)
    actions[1] = np.nan
    with pytest.warns(UserWarning, match="not finite"):
        infos = envs.step(actions)[4]
    assert infos["cbf/nonfinite"][1] and infos["cbf/fallback"][1]
    assert np.isfinite(infos["executed_action"]).all()
