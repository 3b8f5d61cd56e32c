"""The registry of info keys against what the wrappers and tasks really write."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import actions
from wrapper_examples import CASES, build, example, inside

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.wrappers.faults import RepeatedCommands

MORE = [
    lambda: sw.RecordInterventions(RepeatedCommands(gym.make("Pendulum-v1", max_episode_steps=20), 0.5)),
    lambda: gym.make("FlexJointReach-v0"),
    lambda: gym.make("SafeRover-v0"),
    lambda: gym.make("PatrolledPointMaze-v0"),
]
"""What writes the keys that no exported wrapper writes on the tasks of the contract."""


def infos(env):
    yield env.reset(seed=0)[1]
    for action in actions(env, 20):
        *_, over, truncated, info = env.step(action)
        yield info
        if over or truncated:
            return


def check(key, value):
    if key.dtype == "dict":
        assert isinstance(value, dict), key
        return
    array = np.asarray(value)
    assert array.dtype == np.dtype(key.dtype), (key, array.dtype)
    assert array.ndim == (1 if key.shape else 0), (key, array.shape)
    if key.shape == "(3,)":
        assert array.shape == (3,), key


@pytest.mark.filterwarnings("ignore:a control step of")
def test_what_is_written_is_registered_as_it_is_and_what_is_registered_is_written():
    told = [info for make in MORE for info in infos(make())]
    for name, case in CASES:
        bare = inside(name, gym.make(example(name, case)[0]))
        of_the_task = {key for info in infos(bare) for key in info}
        by_all = list(infos(build(name, case)))
        assert {key for info in by_all for key in info} - of_the_task <= set(keys.KEYS), name
        told += by_all
    for info in told:
        for key in set(info) & set(keys.KEYS):
            check(keys.KEYS[key], info[key])
    assert set(keys.KEYS) <= {key for info in told for key in info}


def test_the_constants_are_the_names_and_figures_are_made_of_registered_keys():
    constants = {v for k, v in vars(keys).items() if k.isupper() and type(v) is str}
    assert constants == set(keys.KEYS)
    assert {name for figure in keys.EPISODE for name in figure.of} <= set(keys.KEYS)
    logged = [key.log for key in keys.KEYS.values() if key.log]
    assert len(set(logged)) == len(logged)


def test_infos_of_several_steps_are_merged_as_the_registry_says():
    steps = [
        {
            keys.CBF_INTERVENED: flag,
            keys.CBF_MARGIN: margin,
            keys.COST: 1.0,
            keys.CONTACT_PEAK_FORCE: force,
            "own": flag,
        }
        for flag, margin, force in ((False, 0.3, 2.0), (True, 0.1, 9.0), (False, 0.2, np.nan))
    ]
    steps[1][keys.CBF_REFUSED], steps[2][keys.CBF_REFUSED] = np.array([True, False]), np.array([False, False])
    found = keys.merged([dict(step) for step in steps])
    assert found.pop(keys.CBF_REFUSED).tolist() == [True, False]
    assert found == {
        keys.CBF_INTERVENED: True,
        keys.CBF_MARGIN: 0.1,
        keys.COST: 3.0,
        keys.CONTACT_PEAK_FORCE: 9.0,  # NaN is no report
        "own": False,  # of the last step
    }
    assert type(found[keys.CBF_INTERVENED]) is bool and keys.merged(steps[:1]) is steps[0]
