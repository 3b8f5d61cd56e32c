"""Infos arrive whole: fixed keys, fixed dtypes, one row per sub-env that has something to say."""

import contextlib

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from single_loops import script
from vector_worlds import TASKS, cart, cart_filter, sub_envs

import safe_wrappers as sw
from safe_wrappers import info as keys

SAME = AutoresetMode.SAME_STEP
pytestmark = pytest.mark.filterwarnings("ignore:the policy's action:UserWarning")
every_mode = pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)


def said(*actions):
    return np.array(actions, np.float32)[:, None]


def wanted_dtype(key):
    return np.dtype(bool) if key in keys.CBF_BOOLS else np.dtype(np.float64)


@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_nothing_then_a_fraction_is_not_cut_to_nothing(kind):
    # A vector env takes a key's dtype from the first sub-env that reports it.
    with contextlib.closing(kind(sub_envs(cart_filter))) as envs:
        envs.reset(seed=0, options={"start": [-1.0, 0.0]})
        infos = envs.step(said(0.25, 1.7, 0.25))[4]
    assert infos["cbf/correction"][0] == 0.0 and infos["cbf/correction"][1] == pytest.approx(0.7)
    assert infos["executed_action"].tolist() == [[0.25], [1.0], [0.25]]
    assert infos["proposed_action"].shape == (3, 1)


@every_mode
@pytest.mark.parametrize("task", TASKS)
def test_dtypes_shapes_and_masks_at_every_step_and_reset(task, mode):
    envs = SyncVectorEnv(sub_envs(TASKS[task]), autoreset_mode=mode)
    m = envs.single_action_space.shape[0]
    actions = script(envs.single_action_space)
    _, infos = envs.reset(seed=3)
    always = {*keys.CBF_BOOLS, *keys.CBF_FLOATS}
    resets = np.zeros(3, bool)
    for t in range(20):
        for key in always:
            assert infos[key].dtype == wanted_dtype(key) and infos[key].shape == (3,), key
            assert infos[f"_{key}"].all(), f"{key} at every step and at every reset"
        refused = infos[keys.CBF_REFUSED]
        assert refused.dtype == np.bool_ and refused.shape == (3, len(envs.get_attr("constraint_names")[0]))
        _, _, terminated, truncated, infos = envs.step(np.stack([actions(i, 0, t) for i in range(3)]))
        ended = terminated | truncated
        stepped = ~ended if mode is SAME else ~resets
        for key in (keys.EXECUTED_ACTION, keys.PROPOSED_ACTION):
            if stepped.any():
                assert infos[key].shape == (3, m) and infos[key].dtype == np.float64, key
                assert infos[f"_{key}"][stepped].all(), f"{key} where a step was made"
        summaries = infos.get("final_info", {}) if mode is SAME else infos
        assert ("interventions" in summaries) == ended.any()
        if ended.any():
            assert summaries["_interventions"].tolist() == ended.tolist()
            for name, column in summaries["interventions"].items():
                if not name.startswith("_"):
                    assert column.dtype in (np.int64, np.float64, np.bool_), name
                    assert summaries["interventions"][f"_{name}"].tolist() == ended.tolist(), name
        if mode is SAME:
            assert set(infos) >= {"final_obs", "final_info"} or not ended.any()
        resets = ended if mode is AutoresetMode.NEXT_STEP else np.zeros(3, bool)
        if mode is AutoresetMode.DISABLED and ended.any():
            _, again = envs.reset(options={"reset_mask": ended})
            for key in always:
                assert again[key].dtype == wanted_dtype(key)
                assert again[f"_{key}"].tolist() == ended.tolist()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, SAME], ids=lambda mode: mode.value)
def test_no_key_goes_missing_when_all_sub_envs_reset_at_once(mode):
    # Tasks that only a time limit ends do: a loop that reads infos["executed_action"] must not fail there.
    envs = SyncVectorEnv(sub_envs(cart), autoreset_mode=mode)
    envs.reset(seed=0, options={"ends": [[2]] * 3})
    for _ in range(3):
        infos = envs.step(said(0.0, 0.0, 0.0))[4]
        for key in (*keys.CBF_BOOLS, *keys.CBF_FLOATS, "proposed_action", "executed_action"):
            assert infos[f"_{key}"].all(), key


def test_the_episodes_summary_arrives_whole_on_the_step_that_ends_it():
    envs = SyncVectorEnv(sub_envs(cart))
    ends = [[3], [5], [-4]]
    envs.reset(seed=1, options={"ends": ends, "start": [-1.0, 0.0]})
    arrived = {}
    rewards = np.zeros(3)
    for t in range(1, 6):
        _, reward, _, _, infos = envs.step(said(0.5, 1.5, np.nan))
        for i in np.flatnonzero(infos.get("_interventions", ())):
            arrived[int(i)] = t, {k: v[i] for k, v in infos["interventions"].items() if k[0] != "_"}
            rewards[i] += reward[i]
        rewards += np.where([i in arrived for i in range(3)], 0.0, reward)
    assert {i: t for i, (t, _) in arrived.items()} == {0: 3, 1: 5, 2: 4}
    for i, (t, summary) in arrived.items():
        assert summary["length"] == t and summary["return"] == pytest.approx(rewards[i])
    assert arrived[0][1]["intervention_rate"] == 0.0
    assert arrived[1][1]["correction_p95"] >= 0.5 and arrived[1][1]["nonfinite"] == 0
    assert arrived[2][1]["nonfinite"] == arrived[2][1]["fallback"] == 4


@pytest.mark.parametrize("kind", ["sync", "async"])
def test_make_vec_with_our_wrappers(kind):
    wrappers = [sw.protect, sw.RecordInterventions]
    envs = gym.make_vec("SafePointGoal1-v0", 2, vectorization_mode=kind, wrappers=wrappers)
    with contextlib.closing(envs):
        envs.reset(seed=0)
        infos = envs.step(envs.action_space.sample())[4]
        assert infos["executed_action"].shape == (2, 2)
